// SPDX-License-Identifier: Apache-2.0
#include "tests/fuzz/fuzzer.hpp"

#include <fmt/format.h>
#include <google/protobuf/stubs/logging.h>
#include <sanitizer/allocator_interface.h>
#include <sys/mman.h>
#include <time.h>

#include <algorithm>
#include <array>
#include <cstdint>
#include <cstdlib>

namespace dssm::fuzz {
namespace {

// For a build that is not optimized, with sanitizers. Processor time, which other programs of this
// PC do not lengthen much.
constexpr std::int64_t kBaseNs = 500'000'000, kNsPerByte = 2000;
constexpr std::size_t kBaseMemory = 2U << 20, kMemoryPerByte = 16;

std::size_t fed_bytes = 0;
// Of the heap. It is measured after each kSampleBytes that were allocated.
constexpr std::size_t kSampleBytes = 64U << 10;
thread_local std::size_t not_measured = 0;
thread_local std::size_t peak_memory = 0;
// Of the newest large block, only what has been used counts: protobuf reserves up to 50 MB for a
// string in a message that claims to be longer than what is around it, then finds that the bytes
// are not there (ReadStringFallback() of its parse_context.cc).
constexpr std::size_t kLargeBytes = 1U << 20, kMaxReservedBytes = 50'000'100;
thread_local std::uintptr_t large_block = 0;  // 0: none
thread_local std::size_t large_bytes = 0;

// How many bytes of the newest large block are not in memory.
std::size_t unused_bytes() {
  if (large_block == 0) return 0;
  constexpr std::uintptr_t kPage = 4096;
  static std::array<unsigned char, kMaxReservedBytes / kPage + 2> in_memory;
  const std::uintptr_t begin = (large_block + kPage - 1) / kPage * kPage;
  const std::size_t pages = (large_block + large_bytes - begin) / kPage;
  // NOLINTNEXTLINE(performance-no-int-to-ptr)
  if (::mincore(reinterpret_cast<void*>(begin), pages * kPage, in_memory.data())) return 0;
  const auto unused = std::count_if(in_memory.begin(), in_memory.begin() + pages,
                                    [](unsigned char state) { return (state & 1) == 0; });
  return static_cast<std::size_t>(unused) * kPage;
}

void measure(std::size_t not_counted) {
  const std::size_t all = __sanitizer_get_current_allocated_bytes();
  peak_memory = std::max(peak_memory, all - not_counted);
}

void on_malloc(const volatile void* block, std::size_t bytes) {
  not_measured += bytes;
  if (not_measured < kSampleBytes) return;
  not_measured = 0;
  if (bytes >= kLargeBytes && bytes <= kMaxReservedBytes) {
    measure(unused_bytes() + bytes);  // as it was before this block
    large_block = reinterpret_cast<std::uintptr_t>(block);
    large_bytes = bytes;
  }
  measure(unused_bytes());
}

void on_free(const volatile void* block) {
  if (large_block == 0 || reinterpret_cast<std::uintptr_t>(block) != large_block) return;
  measure(unused_bytes());
  large_block = 0;
}

std::int64_t processor_time_ns() {
  timespec time{};
  ::clock_gettime(CLOCK_THREAD_CPUTIME_ID, &time);
  return time.tv_sec * 1'000'000'000 + time.tv_nsec;
}

void check(const char* what, std::size_t used, std::size_t allowed) {
  if (used <= allowed) return;
  fmt::print(stderr, "ERROR: an input of {} bytes takes {} {}; {} are allowed\n", fed_bytes, used,
             what, allowed);
  std::abort();
}

void run_within_limits(std::span<const std::uint8_t> input) {
  fed_bytes = input.size();
  const std::size_t memory = __sanitizer_get_current_allocated_bytes();
  peak_memory = memory;
  const std::int64_t began = processor_time_ns();
  run_input(input);
  const std::int64_t took = processor_time_ns() - began;
  const auto bytes = static_cast<std::int64_t>(fed_bytes);
  check("ns of processor time", static_cast<std::size_t>(took),
        static_cast<std::size_t>(kBaseNs + kNsPerByte * bytes));
  check("bytes of memory", peak_memory - memory, kBaseMemory + kMemoryPerByte * fed_bytes);
}

}  // namespace

void count_bytes(std::size_t bytes) noexcept { fed_bytes += bytes; }

}  // namespace dssm::fuzz

extern "C" int LLVMFuzzerInitialize(int*, char***) {
  google::protobuf::SetLogHandler(nullptr);  // it would print each message that it refuses
  if (__sanitizer_install_malloc_and_free_hooks(dssm::fuzz::on_malloc, dssm::fuzz::on_free) == 0) {
    std::abort();
  }
  return 0;
}

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size) {
  dssm::fuzz::run_within_limits({data, size});
  return 0;
}
