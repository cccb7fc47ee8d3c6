// SPDX-License-Identifier: Apache-2.0
//
// Readers that a writer in another process laps all the time never get a torn sample: 10^8 reads in
// all, over three payload sizes and three depths. A sanitizer build, where a read is slower by far,
// does a share of them; it says so.
//
// Every word of a payload is derived from its sample's tid, so that any mixture shows.
#include <sys/prctl.h>
#include <sys/wait.h>

#include <csignal>
#include <cstdio>
#include <cstdlib>

#include "core/ring/copy.hpp"
#include "tests/unit/core/ring/test_ring.hpp"

namespace dssm::ring {
namespace {

#if defined(__SANITIZE_ADDRESS__) || defined(DSSM_TSAN)
constexpr std::int64_t kShare = 200;
#else
constexpr std::int64_t kShare = 1;
#endif

struct Case {
  std::uint64_t payload_bytes;
  std::uint64_t depth;
  std::int64_t reads;
};

// 3 * 30,000,000 + 3 * 3,333,000 + 3 * 400 >= 10^8
constexpr Case kCases[] = {
    {64, 2, 30'000'000},  {64, 3, 30'000'000},  {64, 64, 30'000'000},
    {4096, 2, 3'333'000}, {4096, 3, 3'333'000}, {4096, 64, 3'333'000},
    {1 << 20, 2, 400},    {1 << 20, 3, 400},    {1 << 20, 64, 400},
};

std::uint64_t word_of(Tid tid, std::size_t i) {
  return static_cast<std::uint64_t>(tid) * 0x9e3779b97f4a7c15ULL + i;
}

[[noreturn]] void write_for_ever(const TestRing& ring, std::uint64_t payload_bytes) {
  ::prctl(PR_SET_PDEATHSIG, SIGKILL);
  RingWriter writer = ring.writer();
  std::vector<std::uint64_t> words(payload_bytes / 8);
  for (Tid tid = 0;; ++tid) {
    for (std::size_t i = 0; i < words.size(); ++i) words[i] = word_of(tid, i);
    if (writer.write(std::as_bytes(std::span(words)), time_from_ns(tid), Duration(tid)) != tid) {
      std::abort();
    }
  }
}

class TornReads : public testing::TestWithParam<Case> {};

TEST_P(TornReads, DoNotHappenWhileTheWriterLapsTheReader) {
  const Case& test = GetParam();
  const TestRing ring(test.payload_bytes, test.depth);
  const pid_t writer = ::fork();
  if (writer == 0) write_for_ever(ring, test.payload_bytes);

  const RingReader reader = ring.reader();
  while (reader.newest() < static_cast<Tid>(test.depth)) {  // until laps have begun
    const std::uint32_t announced = ring.bell->announce();
    if (reader.newest() < static_cast<Tid>(test.depth)) (void)ring.bell->sleep(announced, kNever);
  }
  std::vector<std::uint64_t> words(test.payload_bytes / 8);
  const auto bytes = std::as_writable_bytes(std::span(words));
  const std::int64_t reads = std::max<std::int64_t>(test.reads / kShare, 50);
  std::int64_t whole = 0, refused = 0, torn = 0;
  for (std::int64_t i = 0; i < reads; ++i) {
    SampleInfo info;
    // By turns the newest, the oldest (which is being overwritten next), and one by time.
    ReadStatus status = ReadStatus::not_yet;
    if (i % 4 == 0) {
      status = reader.read(reader.oldest(), bytes, info);
    } else if (i % 4 == 1) {
      Tid tid = kNoTid;
      status = reader.find(time_from_ns(std::max<Tid>(reader.newest() - 1, 0)), tid);
      if (status == ReadStatus::ok) status = reader.read(tid, bytes, info);
    } else {
      status = reader.read(reader.newest(), bytes, info);
    }
    if (status != ReadStatus::ok) {
      ++refused;
      continue;
    }
    ++whole;
    std::uint64_t difference = static_cast<std::uint64_t>(to_ns(info.time) ^ info.tid) |
                               static_cast<std::uint64_t>(info.clock_error.count() ^ info.tid);
    for (std::size_t w = 0; w < words.size(); ++w) difference |= words[w] ^ word_of(info.tid, w);
    if (difference != 0) ++torn;
  }
  ::kill(writer, SIGKILL);
  ::waitpid(writer, nullptr, 0);
  std::printf("%lld reads: %lld whole, %lld refused because lapped, %lld torn\n",
              static_cast<long long>(reads), static_cast<long long>(whole),
              static_cast<long long>(refused), static_cast<long long>(torn));
  EXPECT_EQ(torn, 0);
  EXPECT_GT(whole, 0) << "nothing was read, so nothing was tested";
}

INSTANTIATE_TEST_SUITE_P(AllSizes, TornReads, testing::ValuesIn(kCases), [](const auto& test) {
  return std::to_string(test.param.payload_bytes) + "BytesDepth" + std::to_string(test.param.depth);
});

}  // namespace
}  // namespace dssm::ring
