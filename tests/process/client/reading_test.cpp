// SPDX-License-Identifier: Apache-2.0
//
// Reads by time beside the cursor, with a maximum age and between samples; reads without
// out-parameters; and waits for a duration.
#include <gtest/gtest.h>

#include <array>
#include <dssm/dssm.hpp>

#include "tests/support/daemon_process.hpp"
#include "tests/support/samples.hpp"
#include "tests/support/session.hpp"

namespace dssm {
namespace {

using namespace std::chrono_literals;

// Sample `tid` has the number 10 * tid and the time 100 ms * tid.
struct Reading : testing::Test {
  static Time at(Tid tid) { return time_from_ns(tid * 100'000'000); }
  void write(Tid first, Tid last) {
    for (Tid tid = first; tid <= last; ++tid) {
      ASSERT_EQ(writer.write(10.0 * static_cast<double>(tid), at(tid)), tid);
    }
  }

  test::DaemonProcess daemon;
  Session session = test::connect(daemon);
  Writer<double> writer = session.create<double>("s", History{16, 100ms}).value();
  Reader<double> reader = session.open_reader<double>("s").value();
  double out = -1;
  SampleInfo info;
};

TEST_F(Reading, ByTimeLeavesTheCursor) {
  write(0, 9);
  reader.seek(3);
  EXPECT_EQ(reader.read_at(at(7), out, info), ReadStatus::ok);
  EXPECT_EQ(info.tid, 7);
  EXPECT_EQ(reader.read_at_or_after(at(6), out, info), ReadStatus::ok);
  EXPECT_EQ(reader.read_nearest(at(5), out, info), ReadStatus::ok);
  EXPECT_TRUE(reader.read_neighbours(at(8)));
  std::array joint{reader.joint_sample(out)};
  EXPECT_EQ(read_joint_at(at(2), joint).status, ReadStatus::ok);
  EXPECT_EQ(reader.cursor(), 3);
  ASSERT_EQ(reader.read_next(out, info), ReadStatus::ok);
  EXPECT_EQ(info.tid, 4) << "none left out, none twice";

  EXPECT_EQ(reader.read_at(at(7), out, info), ReadStatus::ok);
  reader.seek(info.tid);
  ASSERT_EQ(reader.read_next(out, info), ReadStatus::ok);
  EXPECT_EQ(info.tid, 8) << "where it was sent to";
}

TEST_F(Reading, ByTimeLeavesANewReaderNew) {
  write(0, 9);
  EXPECT_EQ(reader.read_at(at(2), out, info), ReadStatus::ok);
  EXPECT_EQ(reader.cursor(), kNoTid);
  EXPECT_EQ(reader.read_previous(out, info), ReadStatus::not_yet);
  ASSERT_EQ(reader.read_next(out, info), ReadStatus::ok);
  EXPECT_EQ(info.tid, 9);
}

TEST_F(Reading, ByTidSetsTheCursor) {
  write(0, 9);
  EXPECT_EQ(reader.read_tid(4, out, info), ReadStatus::ok);
  EXPECT_EQ(reader.cursor(), 4);
  BorrowedSample borrowed;
  EXPECT_EQ(reader.borrow(5, borrowed), ReadStatus::ok);
  EXPECT_EQ(reader.cursor(), 5);
  EXPECT_EQ(reader.read_newest(out, info), ReadStatus::ok);
  EXPECT_EQ(reader.cursor(), 9);
}

TEST_F(Reading, NeverReturnsASampleOlderThanTheMaximumAge) {
  EXPECT_EQ(reader.read_at(at(0), out, info, 1h), ReadStatus::not_yet);
  write(0, 4);
  ASSERT_EQ(reader.read_at(at(4) + 30ms, out, info, 30ms), ReadStatus::ok);
  EXPECT_EQ(info.tid, 4);
  EXPECT_EQ(out, 40);
  EXPECT_EQ(reader.read_at(at(4) + 31ms, out, info, 30ms), ReadStatus::stale);
  EXPECT_EQ(info.tid, 4) << "arguments stay as they were";
  EXPECT_EQ(reader.read_at(at(2) + 1ns, out, info, 0ns), ReadStatus::stale);
  EXPECT_EQ(reader.read_at(at(2), out, info, 0ns), ReadStatus::ok);
  EXPECT_EQ(reader.read_at(at(0) - 1ns, out, info, 0ns), ReadStatus::too_old);
  EXPECT_EQ(reader.read_at(Time::max(), out, info, 24h), ReadStatus::stale);
  EXPECT_EQ(reader.read_at(Time::max(), out, info, kAnyAge), ReadStatus::ok);
  EXPECT_EQ(reader.read_at(Time::max(), out, info), ReadStatus::ok);
  EXPECT_EQ(reader.read_at(at(4) + 31ms, 30ms).status(), ReadStatus::stale);
}

TEST_F(Reading, OfSeveralStreamsHasOneMaximumAge) {
  auto slow_writer = session.create<double>("slow", History{16, 1s}).value();
  auto slow = session.open_reader<double>("slow").value();
  write(0, 4);
  slow_writer.write(1, at(1));
  double slow_out = -1;
  std::array joint{reader.joint_sample(out), slow.joint_sample(slow_out)};
  EXPECT_EQ(read_joint_at(at(4), joint, 0ns, 300ms).status, ReadStatus::ok);
  const JointRead read = read_joint_at(at(4), joint, 0ns, 299ms);
  EXPECT_EQ(read.status, ReadStatus::stale);
  EXPECT_EQ(read.index, 1u);
}

TEST_F(Reading, WithoutOutParametersReturnsTheSame) {
  EXPECT_EQ(reader.read_newest().status(), ReadStatus::not_yet);
  EXPECT_EQ(reader.read_next().status(), ReadStatus::not_yet);
  EXPECT_EQ(reader.read_neighbours(at(1)).status(), ReadStatus::not_yet);
  write(0, 9);
  const auto expect = [](const SampleOr<double>& sample, Tid tid) {
    ASSERT_TRUE(sample) << name_of(sample.status());
    EXPECT_EQ(sample->tid(), tid);
    EXPECT_EQ(sample->time(), at(tid));
    EXPECT_EQ(sample->value, 10.0 * static_cast<double>(tid));
    EXPECT_EQ(sample->clock_error(), sample->info.clock_error);
    EXPECT_EQ(sample->info.payload_bytes, sizeof(double));
  };
  expect(reader.read_newest(), 9);
  expect(reader.read_tid(3), 3);
  expect(reader.read_next(), 4);
  expect(reader.read_previous(), 3);
  expect(reader.read_at(at(5) + 10ms), 5);
  expect(reader.read_at_or_after(at(5) + 10ms), 6);
  expect(reader.read_nearest(at(5) + 60ms), 6);
  EXPECT_EQ(reader.read_at(at(0) - 1ns).status(), ReadStatus::too_old);
  EXPECT_EQ(reader.read_tid(10).status(), ReadStatus::not_yet);
}

TEST_F(Reading, ReadsBothNeighbours) {
  write(0, 9);
  const auto around = reader.read_neighbours(at(5) + 25ms);
  ASSERT_TRUE(around);
  EXPECT_EQ(around->before.tid(), 5);
  EXPECT_EQ(around->before.value, 50);
  EXPECT_EQ(around->after.tid(), 6);
  EXPECT_EQ(around->after.value, 60);
  EXPECT_EQ(reader.read_neighbours(at(5))->before.tid(), 5);
  EXPECT_EQ(reader.read_neighbours(at(9)).status(), ReadStatus::not_yet);
  EXPECT_EQ(reader.read_neighbours(at(0) - 1ns).status(), ReadStatus::too_old);
}

TEST_F(Reading, ShorterNeighboursEndInZeros) {
  RawWriter raw = session.create_raw({"short", 0, ""}, {"", 8, 1, {}}, {4, 10ms}).value();
  using Bytes = std::array<std::uint8_t, 8>;
  const Bytes ones{1, 1, 1, 1, 1, 1, 1, 1};
  for (Tid tid = 0; tid < 8; ++tid) raw.write(test::bytes_of(ones), at(tid));  // in every slot
  raw.write(test::bytes_of(ones).first(3), at(8));
  raw.write(test::bytes_of(ones).first(5), at(9));
  auto bytes = session.open_reader<Bytes>("short").value();
  const auto around = bytes.read_neighbours(at(8));
  ASSERT_TRUE(around);
  EXPECT_EQ(around->before.value, (Bytes{1, 1, 1}));
  EXPECT_EQ(around->after.value, (Bytes{1, 1, 1, 1, 1}));
}

TEST_F(Reading, NeighboursAreWholeWhileTheWriterOvertakes) {
  auto fast = session.create<test::Numbered>("fast", History{4, 1ms}).value();
  auto numbers = session.open_reader<test::Numbered>("fast").value();
  test::WriterThread writing(fast, 0us);
  writing.await_more(10);
  for (int found = 0; found < 2000;) {
    SampleInfo newest;
    if (numbers.read_info(numbers.newest_tid(), newest) != ReadStatus::ok) continue;
    const Time t = newest.time - 1ns;
    const auto around = numbers.read_neighbours(t);
    if (!around) {
      ASSERT_TRUE(around.status() == ReadStatus::too_old || around.status() == ReadStatus::not_yet)
          << name_of(around.status());
      continue;
    }
    ASSERT_TRUE(is_whole(around->before.value) && is_whole(around->after.value));
    ASSERT_EQ(around->before.value.number, around->before.tid());
    ASSERT_EQ(around->after.value.number, around->after.tid());
    ASSERT_LE(around->before.time(), t);
    ASSERT_GT(around->after.time(), t);
    ++found;
  }
}

TEST_F(Reading, WaitsForADuration) {
  EXPECT_EQ(reader.wait(0ns), WaitStatus::timeout);
  const auto start = std::chrono::steady_clock::now();
  EXPECT_EQ(reader.wait(10ms), WaitStatus::timeout);
  EXPECT_EQ(reader.wait_for_tid(0, 10ms), WaitStatus::timeout);
  EXPECT_EQ(reader.wait_for_sample(0, 10ms), WaitStatus::timeout);
  RawReader* const all[] = {&reader};
  EXPECT_EQ(wait_any(all, 10ms), WaitStatus::timeout);
  EXPECT_EQ(session.await_reader<double>("other", 10ms).error().code, Errc::not_found);
  EXPECT_GE(std::chrono::steady_clock::now() - start, 50ms);
  write(0, 0);
  EXPECT_EQ(reader.wait(1h), WaitStatus::ready);
  EXPECT_EQ(reader.wait(std::chrono::hours(2'000'000)), WaitStatus::ready) << "almost for ever";
  EXPECT_EQ(reader.wait_for_tid(0, 1h), WaitStatus::ready);
  EXPECT_EQ(reader.wait_for_sample(0, 1h), WaitStatus::ready);
  EXPECT_EQ(wait_any(all, 1h), WaitStatus::ready);
  EXPECT_TRUE(session.await_reader<double>("s", 1h));
}

TEST_F(Reading, WaitsUntilATimeOfTheSteadyClock) {
  const auto until = std::chrono::steady_clock::now() + 10ms;
  EXPECT_EQ(reader.wait(until), WaitStatus::timeout);
  EXPECT_GE(std::chrono::steady_clock::now(), until);
}

}  // namespace
}  // namespace dssm
