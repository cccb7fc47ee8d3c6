// SPDX-License-Identifier: Apache-2.0
//
// SampleCollector against a real dssmd.
#include <gtest/gtest.h>
#include <signal.h>
#include <sys/wait.h>
#include <unistd.h>

#include <dssm/dssm.hpp>
#include <optional>
#include <random>
#include <thread>

#include "tests/support/await.hpp"
#include "tests/support/daemon_process.hpp"
#include "tests/support/session.hpp"

namespace dssm::test {
namespace {

using namespace std::chrono_literals;

struct Collected {
  std::array<std::int64_t, 32> words{};  // all the same: the sample's number
  std::span<std::byte> span() { return std::as_writable_bytes(std::span(words)); }
  bool is_whole() const {
    return std::all_of(words.begin(), words.end(), [&](auto word) { return word == words[0]; });
  }
};

struct SampleCollection : testing::Test {
  DaemonProcess daemon{{"--log-level", "warning"}, "pc2"};
  Session session = connect(daemon);
  Collected sample;
  SampleInfo info;

  Writer<Collected> make(std::uint64_t depth) {
    return session.create<Collected>("lidar", History{depth, 1ms}).value();
  }
  static Time time_at(std::int64_t number) { return time_from_ns(number * 1'000'000); }
  static void write_numbers(Writer<Collected>& writer, std::int64_t first, std::int64_t last) {
    for (std::int64_t number = first; number <= last; ++number) {
      Collected written;
      written.words.fill(number);
      ASSERT_NE(writer.write(written, time_at(number), Duration(number)), kNoTid);
    }
  }

  PConnector connector() const {
    return PConnector::open({"lidar", 0, {}}, {.address = daemon.address(), .request_timeout = 60s})
        .value();
  }
  SampleCollector collect(SampleCollectorOptions options = {}) const {
    return SampleCollector::start(connector(), {.start = Subscription::Start::oldest},
                                  std::move(options))
        .value();
  }
  static void await_tid(const SampleCollector& collector, Tid tid) {
    await([&] { return collector.newest_tid() >= tid; });
  }
  void expect_sample(std::int64_t number, Tid tid) {
    EXPECT_EQ(info.tid, tid);
    EXPECT_EQ(info.time, time_at(number));
    EXPECT_EQ(info.clock_error, Duration(number));
    EXPECT_EQ(sample.words[0], number);
    EXPECT_TRUE(sample.is_whole());
  }
};

TEST_F(SampleCollection, ReadsAsALocalReaderDoes) {
  auto writer = make(64);
  const SampleCollector collector = collect();
  EXPECT_EQ(collector.id().str(), "lidar:0@pc2");
  EXPECT_EQ(collector.payload_bytes(), sizeof(Collected));
  EXPECT_EQ(collector.depth(), 64u);
  EXPECT_EQ(collector.read_newest(sample.span(), info), ReadStatus::not_yet);
  EXPECT_EQ(collector.read_newer(kNoTid, sample.span(), info), ReadStatus::not_yet);
  EXPECT_EQ(collector.read_at(time_at(3), sample.span(), info), ReadStatus::not_yet);
  EXPECT_EQ(collector.newest_tid(), kNoTid);
  EXPECT_EQ(collector.oldest_tid(), kNoTid);
  EXPECT_EQ(collector.find(time_at(3)), kNoTid);
  // In steps that the owner's ring holds, so that nothing is lost.
  for (Tid tid = 0; tid < 200; tid += 50) {
    write_numbers(writer, tid, tid + 49);
    await_tid(collector, tid + 49);
  }
  auto local = session.open_reader<Collected>("lidar").value();
  Collected here;
  SampleInfo info_here;
  const std::random_device::result_type seed = std::random_device()();
  SCOPED_TRACE(testing::Message() << "seed " << seed);
  std::mt19937_64 random(seed);
  for (int i = 0; i < 10'000; ++i) {
    const Tid tid = static_cast<Tid>(random() % 220) - 10;
    const Time time = time_at(tid) + Duration(static_cast<std::int64_t>(random() % 1'000'000));
    const ReadStatus by_tid = collector.read_tid(tid, sample.span(), info);
    ASSERT_EQ(by_tid, local.read_tid(tid, here, info_here));
    if (by_tid == ReadStatus::ok) expect_sample(tid, tid);
    const Duration age =
        i % 2 ? kAnyAge : Duration(static_cast<std::int64_t>(random() % 2'000'000));
    const ReadStatus by_time = collector.read_at(time, sample.span(), info, age);
    ASSERT_EQ(by_time, local.read_at(time, here, info_here, age));
    if (by_time == ReadStatus::ok) expect_sample(info_here.tid, info_here.tid);
    SampleInfo found;
    const bool is_there = local.find(time, found) == ReadStatus::ok;
    ASSERT_EQ(collector.find(time), is_there ? found.tid : kNoTid);
  }
  EXPECT_EQ(collector.newest_tid(), 199);
  EXPECT_EQ(collector.oldest_tid(), local.oldest_tid());
  const Time late = time_at(199) + 1ms;
  EXPECT_EQ(collector.read_at(late, sample.span(), info, 1ms), ReadStatus::ok);
  info = {};
  EXPECT_EQ(collector.read_at(late, sample.span(), info, 1ms - 1ns), ReadStatus::stale);
  EXPECT_EQ(info.tid, kNoTid) << "set only when ok";
  EXPECT_EQ(collector.read_newer(198, sample.span(), info), ReadStatus::ok);
  expect_sample(199, 199);
  EXPECT_EQ(collector.read_newer(199, sample.span(), info), ReadStatus::not_yet);
  EXPECT_EQ(collector.read_newest(sample.span(), info), ReadStatus::ok);
  expect_sample(199, 199);
  EXPECT_EQ(collector.lost_samples(), 0u);
}

TEST_F(SampleCollection, HoldsMoreOrLessThanTheOwnersRing) {
  auto writer = make(64);
  const SampleCollector small = collect({.depth = 5});
  const SampleCollector large = collect({.depth = 1000});
  for (Tid tid = 0; tid < 500; tid += 50) {
    write_numbers(writer, tid, tid + 49);
    await_tid(small, tid + 49);
    await_tid(large, tid + 49);
  }
  EXPECT_EQ(small.depth(), 5u);
  EXPECT_EQ(small.oldest_tid(), 496);
  EXPECT_EQ(small.read_tid(495, sample.span(), info), ReadStatus::too_old);
  EXPECT_EQ(small.read_tid(496, sample.span(), info), ReadStatus::ok);
  expect_sample(496, 496);
  EXPECT_EQ(large.oldest_tid(), 0);
  EXPECT_EQ(large.read_at(time_at(0), sample.span(), info), ReadStatus::ok);
  expect_sample(0, 0);
}

TEST_F(SampleCollection, ReadersInManyThreadsGetWholeSamplesOfAFastWriter) {
  constexpr Tid kCount = 20'000;
  auto writer = make(1U << 15);
  const SampleCollector collector = collect({.depth = 8});
  std::vector<std::thread> readers;
  for (int i = 0; i < 3; ++i) {
    readers.emplace_back([&, i] {
      Collected read;
      SampleInfo its;
      for (Tid newest = kNoTid; newest < kCount - 1; newest = collector.newest_tid()) {
        const ReadStatus status =
            i == 0   ? collector.read_newest(read.span(), its)
            : i == 1 ? collector.read_tid(collector.oldest_tid() + 1, read.span(), its)
                     : collector.read_at(time_at(collector.newest_tid()), read.span(), its);
        if (status != ReadStatus::ok) continue;
        ASSERT_TRUE(read.is_whole());
        ASSERT_EQ(read.words[0], its.tid);
        ASSERT_EQ(its.time, time_at(its.tid));
      }
    });
  }
  write_numbers(writer, 0, kCount - 1);
  for (std::thread& reader : readers) reader.join();
  EXPECT_EQ(collector.lost_samples(), 0u);
}

TEST_F(SampleCollection, CountsWhatTheOwnersRingLostAndKeepsOnlyWhatFollows) {
  auto writer = make(16);
  write_numbers(writer, 0, 0);
  const SampleCollector collector = collect({.depth = 4096});
  await_tid(collector, 0);
  ::kill(daemon.pid(), SIGSTOP);
  write_numbers(writer, 1, 1000);
  ::kill(daemon.pid(), SIGCONT);
  await_tid(collector, 1000);
  EXPECT_GT(collector.lost_samples(), 0u);
  EXPECT_EQ(collector.read_tid(0, sample.span(), info), ReadStatus::too_old);
  for (Tid tid = collector.oldest_tid(); tid <= 1000; ++tid) {
    ASSERT_EQ(collector.read_tid(tid, sample.span(), info), ReadStatus::ok);
    expect_sample(tid, tid);
  }
}

TEST_F(SampleCollection, TidsKeepRisingWhenTheStreamRestarts) {
  auto writer = make(64);
  write_numbers(writer, 0, 9);
  const SampleCollector collector = collect();
  await_tid(collector, 9);
  ASSERT_TRUE(session.remove({"lidar", 0, {}}));
  auto recreated = make(64);
  write_numbers(recreated, 100, 104);
  await_tid(collector, 14);
  EXPECT_EQ(collector.restarts(), 1u);
  for (Tid tid = 0; tid < 15; ++tid) {
    ASSERT_EQ(collector.read_tid(tid, sample.span(), info), ReadStatus::ok);
    expect_sample(tid < 10 ? tid : tid + 90, tid);
  }
  EXPECT_EQ(collector.newest_tid(), 14);
}

TEST_F(SampleCollection, ReportsAnErrorAndContinuesAfterARestartOfDssmd) {
  auto writer = make(64);
  std::atomic<int> errors = 0;
  std::string message;
  const SampleCollector collector = collect({.on_error = [&](const Error& error) {
    if (errors == 0) message = error.message;
    ++errors;
  }});
  write_numbers(writer, 0, 9);
  await_tid(collector, 9);
  EXPECT_EQ(errors, 0);
  daemon.kill_hard();
  await([&] { return errors > 0; });
  EXPECT_NE(message.find("lidar"), std::string::npos) << message;
  write_numbers(writer, 10, 19);
  daemon.start();
  await_tid(collector, 19);
  EXPECT_EQ(collector.lost_samples(), 0u);
  EXPECT_EQ(collector.read_tid(10, sample.span(), info), ReadStatus::ok);
  expect_sample(10, 10);
}

TEST_F(SampleCollection, AForkedChildReadsWhatItsParentCollects) {
  auto writer = make(64);
  std::optional<SampleCollector> collector = collect();
  int written_pipe[2];
  ASSERT_EQ(::pipe(written_pipe), 0);
  const pid_t child = ::fork();
  if (child == 0) {
    char byte = 0;
    const bool is_written = ::read(written_pipe[0], &byte, 1) == 1;
    const bool good = is_written && collector->read_tid(5, sample.span(), info) == ReadStatus::ok &&
                      sample.words[0] == 5;
    collector.reset();  // the thread is the parent's
    ::_exit(good ? 0 : 1);
  }
  write_numbers(writer, 0, 9);
  await_tid(*collector, 9);
  ASSERT_EQ(::write(written_pipe[1], "w", 1), 1);
  int status = -1;
  ASSERT_EQ(::waitpid(child, &status, 0), child);
  EXPECT_EQ(status, 0);
  write_numbers(writer, 10, 10);
  await_tid(*collector, 10);
  ::close(written_pipe[0]);
  ::close(written_pipe[1]);
}

TEST_F(SampleCollection, RefusesADepthThatNoRingHas) {
  make(64);
  for (const std::uint64_t depth : {std::uint64_t{1}, kMaxDepth + 1}) {
    const auto refused = SampleCollector::start(connector(), {}, {.depth = depth});
    ASSERT_FALSE(refused);
    EXPECT_EQ(refused.error().code, Errc::invalid_argument);
    EXPECT_NE(refused.error().message.find("lidar"), std::string::npos) << refused.error().message;
  }
}

TEST_F(SampleCollection, MovesAndEndsAtAnyMoment) {
  auto writer = make(64);
  for (int i = 0; i < 20; ++i) {
    SampleCollector first = collect();
    write_numbers(writer, i, i);
    if (i % 2 == 0) await_tid(first, i);
    SampleCollector second = std::move(first);
    if (i % 3 == 0) await_tid(second, i);
    second = collect({.depth = 2});
    await_tid(second, i);
  }
}

}  // namespace
}  // namespace dssm::test
