// SPDX-License-Identifier: Apache-2.0
#include "core/ring/bell.hpp"

#include <linux/futex.h>
#include <sys/syscall.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <cerrno>
#include <climits>

#include "core/base/time.hpp"
#include "core/base/try.hpp"

namespace dssm::ring {
namespace {

constexpr std::size_t kMaxBells = 128;  // FUTEX_WAITV_MAX

// Linux 5.16's futex_waitv; Debian 12's headers have it, the C library has no wrapper.
struct WaitVector {
  std::uint64_t value;
  std::uint64_t address;
  std::uint32_t flags;
  std::uint32_t reserved;
};
constexpr long kFutexWaitvNumber = 449;  // on every architecture
constexpr std::uint32_t kFutex32 = 2;    // FUTEX_32; shared, as FUTEX_PRIVATE_FLAG is not set

WaitStatus outcome(long result, int error, MonoTime deadline) noexcept {
  if (result >= 0 || error == EAGAIN) return WaitStatus::ready;
  if (error == EINTR) return WaitStatus::interrupted;
  return MonoClock::now() >= deadline ? WaitStatus::timeout : WaitStatus::ready;
}

}  // namespace

Result<UniqueFd> create_bell(const std::string& label) {
  return create_sealed_memory("dssm-bell:" + label, sizeof(BellPage), 0600);
}

Result<std::shared_ptr<Bell>> Bell::open_untrusted(int fd) {
  SharedMapping mapping =
      DSSM_TRY(SharedMapping::map_sealed_untrusted(fd, sizeof(BellPage), "bell"));
  return std::shared_ptr<Bell>(new Bell(std::move(mapping)));
}

[[gnu::hot]] void Bell::notify_slow() noexcept {
  // The addition clears bit 0 and changes the count. If another writer did so since the load in
  // notify(), it also woke all.
  std::uint32_t word = page().word.load(std::memory_order_relaxed);
  while (word & kSleeper) {
    if (page().word.compare_exchange_weak(word, word + 1, std::memory_order_seq_cst)) {
      ::syscall(SYS_futex, &page().word, FUTEX_WAKE, INT_MAX, nullptr, nullptr, 0);
      return;
    }
  }
}

[[gnu::hot]] WaitStatus Bell::sleep(std::uint32_t announced, MonoTime deadline,
                                    Duration at_most) noexcept {
  if (deadline == kNever) {  // without asking for the time
    const timespec longest = timespec_of(at_most);
    const long result =
        ::syscall(SYS_futex, &page().word, FUTEX_WAIT, announced, &longest, nullptr, 0);
    return outcome(result, errno, deadline);
  }
  const timespec until = timespec_of(std::min(deadline, deadline_in(at_most)));
  const long result = ::syscall(SYS_futex, &page().word, FUTEX_WAIT_BITSET, announced, &until,
                                nullptr, FUTEX_BITSET_MATCH_ANY);
  return outcome(result, errno, deadline);
}

WaitStatus Bell::sleep_any(std::span<Bell* const> bells, std::span<const std::uint32_t> announced,
                           MonoTime deadline, Duration at_most) noexcept {
  std::array<WaitVector, kMaxBells> vectors;
  const std::size_t count = std::min(bells.size(), kMaxBells);
  for (std::size_t i = 0; i < count; ++i) {
    vectors[i] = {announced[i], reinterpret_cast<std::uintptr_t>(&bells[i]->page().word), kFutex32,
                  0};
  }
  timespec until = timespec_of(std::min(deadline, deadline_in(at_most)));
  const long result =
      ::syscall(kFutexWaitvNumber, vectors.data(), count, 0, &until, CLOCK_MONOTONIC);
  if (result >= 0 || errno != ENOSYS) return outcome(result, errno, deadline);
  until = timespec_of(std::min(deadline, deadline_in(std::chrono::milliseconds(1))));
  const int error = ::clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &until, nullptr);
  if (error == EINTR) return WaitStatus::interrupted;
  return MonoClock::now() >= deadline ? WaitStatus::timeout : WaitStatus::ready;
}

}  // namespace dssm::ring
