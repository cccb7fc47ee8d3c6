// SPDX-License-Identifier: Apache-2.0
//
// Writing and reading a ring in one process: tids, windows, stamps, loans, locks, wake-ups.
#include <fcntl.h>
#include <sys/eventfd.h>
#include <sys/mman.h>

#include <atomic>
#include <random>
#include <thread>

#include "core/ring/copy.hpp"
#include "tests/unit/core/ring/test_ring.hpp"

namespace dssm::ring {
namespace {

using namespace std::chrono_literals;

TEST(RingReader, FindsNothingInAnEmptyRing) {
  const TestRing ring(8, 4);
  const RingReader reader = ring.reader();
  std::byte out[8];
  SampleInfo info;
  Tid tid = 7;
  EXPECT_EQ(reader.newest(), kNoTid);
  EXPECT_EQ(reader.oldest(), kNoTid);
  EXPECT_EQ(reader.read_newest(out, info), ReadStatus::not_yet);
  EXPECT_EQ(reader.read(0, out, info), ReadStatus::not_yet);
  EXPECT_EQ(reader.read(-1, out, info), ReadStatus::too_old);
  EXPECT_EQ(reader.find(time_from_ns(5), tid), ReadStatus::not_yet);
  EXPECT_EQ(tid, 7);
}

TEST(RingReader, ReturnsEachSampleOfTheWindowWithItsStampsAndBytes) {
  for (const std::uint64_t bytes : {1, 7, 8, 40, 64, 65, 4096, 20'000}) {
    for (const std::uint64_t depth : {2, 3, 13, 64}) {
      SCOPED_TRACE(testing::Message() << bytes << " bytes, depth " << depth);
      const TestRing ring(bytes, depth);
      const RingReader reader = ring.reader();
      RingWriter writer = ring.writer();
      std::vector<std::byte> out(bytes);
      for (Tid tid = 0; tid < static_cast<Tid>(2 * depth + 3); ++tid) {  // two laps and a bit
        ASSERT_EQ(writer.write(payload_for(tid, bytes), time_from_ns(1000 + tid), Duration(tid)),
                  tid);
        const Tid oldest = std::max<Tid>(0, tid - static_cast<Tid>(depth) + 2);
        ASSERT_EQ(reader.newest(), tid);
        ASSERT_EQ(reader.oldest(), oldest);
        for (Tid wanted = oldest; wanted <= tid; ++wanted) {
          SampleInfo info;
          ASSERT_EQ(reader.read(wanted, out, info), ReadStatus::ok);
          ASSERT_EQ(out, payload_for(wanted, bytes));
          ASSERT_EQ(info.tid, wanted);
          ASSERT_EQ(to_ns(info.time), 1000 + wanted);
          ASSERT_EQ(info.clock_error, Duration(wanted));
        }
        SampleInfo info;
        ASSERT_EQ(reader.read(oldest - 1, out, info), ReadStatus::too_old);
        ASSERT_EQ(reader.read(tid + 1, out, info), ReadStatus::not_yet);
      }
    }
  }
}

// SSM's rule, and its own example: after 20 writes into 13 slots the window is 8 ... 19.
TEST(RingReader, KeepsOneSlotFreeForTheSampleBeingWritten) {
  const TestRing ring(8, 13);
  RingWriter writer = ring.writer();
  for (Tid tid = 0; tid < 20; ++tid) writer.write(payload_for(tid, 8), time_from_ns(tid), 0ns);
  EXPECT_EQ(ring.reader().newest(), 19);
  EXPECT_EQ(ring.reader().oldest(), 8);
}

TEST(RingWriter, KeepsGuardBytesAfterEachPayload) {
  const TestRing ring(40, 3);
  RingWriter writer = ring.writer();
  for (Tid tid = 0; tid < 7; ++tid) {
    std::byte* slot = writer.begin();
    std::memset(slot, static_cast<int>(tid), 40 + kGuardBytes);  // the widespread overrun
    writer.commit(40, time_from_ns(tid), 0ns);
  }
  std::byte out[40];
  SampleInfo info;
  for (const Tid tid : {5, 6}) {
    ASSERT_EQ(ring.reader().read(tid, out, info), ReadStatus::ok);
    EXPECT_EQ(out[39], static_cast<std::byte>(tid));
  }
}

TEST(RingWriter, KeepsTheLengthOfEachSample) {
  for (const std::uint64_t bytes : {40, 100'000}) {
    const TestRing ring(bytes, 8);
    const RingReader reader = ring.reader();
    RingWriter writer = ring.writer();
    const std::uint64_t lengths[] = {bytes, 0, 1, bytes / 2, bytes - 1, bytes};
    for (const std::uint64_t length : lengths) {
      const Tid tid = reader.newest() + 1;
      if (tid % 2 == 0) {
        ASSERT_EQ(writer.write(payload_for(tid, length), time_from_ns(tid), 0ns), tid);
      } else {
        const std::vector<std::byte> payload = payload_for(tid, length);
        std::copy(payload.begin(), payload.end(), writer.begin());
        ASSERT_EQ(writer.commit(length, time_from_ns(tid), 0ns), tid);
      }
      std::vector<std::byte> out(bytes, std::byte{0xee});
      SampleInfo info;
      ASSERT_EQ(reader.read(tid, out, info), ReadStatus::ok);
      ASSERT_EQ(info.payload_bytes, length);
      std::vector<std::byte> expected = payload_for(tid, length);
      if (bytes > kLargeBytes) {
        expected.resize(bytes, std::byte{0xee});
        EXPECT_EQ(out, expected) << "no byte after the sample is copied";
      } else {
        out.resize(length);
        EXPECT_EQ(out, expected);
      }
      SampleInfo located;
      RingReader::Place place;
      ASSERT_EQ(reader.locate(tid, place, located), ReadStatus::ok);
      EXPECT_EQ(located.payload_bytes, length);
    }
  }
}

TEST(RingReader, TakesNoLengthThatLeavesTheSlot) {
  const TestRing ring(40, 4);
  RingWriter writer = ring.writer();
  writer.write(payload_for(0, 40), time_from_ns(0), 0ns);
  SlotTable(*ring.mapping).slot(0).payload_bytes.store(~std::uint64_t{0});
  std::vector<std::byte> out(40);
  SampleInfo info;
  ASSERT_EQ(ring.reader().read(0, out, info), ReadStatus::ok);
  EXPECT_EQ(info.payload_bytes, 40u);
  ASSERT_EQ(ring.reader().read(0, std::span(out).first(7), info), ReadStatus::ok);
  EXPECT_EQ(info.payload_bytes, 7u);
  ASSERT_EQ(ring.reader().stamp(0, info), ReadStatus::ok);
  EXPECT_EQ(info.payload_bytes, 40u);
}

TEST(RingWriter, PublishesALoanOnlyOnCommit) {
  const TestRing ring(8, 4);
  RingWriter writer = ring.writer();
  const RingReader reader = ring.reader();
  std::byte* slot = writer.begin();
  ASSERT_NE(slot, nullptr);
  EXPECT_EQ(reinterpret_cast<std::uintptr_t>(slot) % 64, 0u);
  std::memset(slot, 1, 8);
  EXPECT_EQ(reader.newest(), kNoTid);
  writer.cancel();
  EXPECT_EQ(reader.newest(), kNoTid);
  slot = writer.begin();
  std::memset(slot, 2, 8);
  EXPECT_EQ(writer.commit(8, time_from_ns(9), 1ns), 0);
  std::byte out[8];
  SampleInfo info;
  ASSERT_EQ(reader.read(0, out, info), ReadStatus::ok);
  EXPECT_EQ(out[0], std::byte{2});
}

TEST(RingWriter, RefusesToDeadlockOnItsOwnLoan) {
  const TestRing ring(8, 4), other(8, 4);
  RingWriter writer = ring.writer(), again = ring.writer(), elsewhere = other.writer();
  ASSERT_NE(writer.begin(), nullptr);
  EXPECT_EQ(writer.begin(), nullptr);
  EXPECT_EQ(again.write(payload_for(0, 8), {}, 0ns), kNoTid);
  EXPECT_EQ(elsewhere.write(payload_for(0, 8), {}, 0ns), 0);
  writer.cancel();
  EXPECT_EQ(again.write(payload_for(0, 8), {}, 0ns), 0);
}

TEST(RingReader, NoticesThatABorrowedSampleWasOverwritten) {
  const TestRing ring(8, 3);
  RingWriter writer = ring.writer();
  const RingReader reader = ring.reader();
  writer.write(payload_for(0, 8), time_from_ns(1), 0ns);
  RingReader::Place place{};
  SampleInfo info;
  ASSERT_EQ(reader.locate(0, place, info), ReadStatus::ok);
  for (Tid tid = 1; tid < 3; ++tid) {
    writer.write(payload_for(tid, 8), time_from_ns(1), 0ns);
    EXPECT_TRUE(RingReader::still_valid(*place.sequence, place.expected));
  }
  writer.begin();  // tid 3 takes the slot of tid 0
  EXPECT_FALSE(RingReader::still_valid(*place.sequence, place.expected));
  writer.cancel();
  EXPECT_FALSE(RingReader::still_valid(*place.sequence, place.expected));
}

// Two writers and two readers on one ring: each tid is written once, and nothing read is mixed.
// ThreadSanitizer watches.
TEST(Ring, GivesWholeSamplesToThreadsThatAreLapped) {
  for (const std::uint64_t depth : {2, 3, 64}) {
    const TestRing ring(256, depth);
    constexpr int kWrites = 20'000;
    std::atomic<int> running = 2;
    std::vector<std::thread> threads;
    std::atomic<std::int64_t> written = 0;
    for (int w = 0; w < 2; ++w) {
      threads.emplace_back([&, w] {
        RingWriter writer = ring.writer();
        for (int i = 0; i < kWrites; ++i) {
          const auto value = static_cast<std::int64_t>(w) << 40 | i;
          std::vector<std::byte> payload(256);
          for (std::size_t at = 0; at < 256; at += 8) std::memcpy(&payload[at], &value, 8);
          if (writer.write(payload, time_from_ns(value), Duration(i)) >= 0) ++written;
        }
        --running;
      });
    }
    for (int r = 0; r < 2; ++r) {
      threads.emplace_back([&] {
        const RingReader reader = ring.reader();
        std::vector<std::byte> out(256);
        while (running.load() > 0) {
          SampleInfo info;
          if (reader.read_newest(out, info) != ReadStatus::ok) continue;
          std::int64_t first = 0;
          std::memcpy(&first, out.data(), 8);
          ASSERT_EQ(to_ns(info.time), first);
          ASSERT_EQ(info.clock_error.count(), first & 0xffffffff);
          for (std::size_t at = 8; at < 256; at += 8) {
            ASSERT_EQ(std::memcmp(&out[at], &first, 8), 0) << "torn at byte " << at;
          }
        }
      });
    }
    for (std::thread& thread : threads) thread.join();
    EXPECT_EQ(written.load(), 2 * kWrites);
    EXPECT_EQ(ring.reader().newest(), 2 * kWrites - 1);
  }
}

TEST(Bell, WakesASleeperForEachSample) {
  const TestRing ring(8, 64);
  constexpr Tid kCount = 2000;
  std::atomic<Tid> seen = kNoTid;
  std::thread sleeper([&] {
    const RingReader reader = ring.reader();
    for (Tid wanted = 0; wanted < kCount; ++wanted) {
      while (reader.newest() < wanted) {
        const std::uint32_t announced = ring.bell->announce();
        if (reader.newest() >= wanted) break;
        (void)ring.bell->sleep(announced, kNever);
      }
      seen.store(wanted);
    }
  });
  RingWriter writer = ring.writer();
  for (Tid tid = 0; tid < kCount; ++tid) {
    writer.write(payload_for(tid, 8), time_from_ns(tid), 0ns);
    // Lock-step: a wake-up that were lost would stand out as a second each time.
    while (seen.load() < tid) std::this_thread::yield();
  }
  sleeper.join();
}

TEST(Bell, SleepEndsAtTheDeadline) {
  const TestRing ring(8, 4);
  EXPECT_EQ(ring.bell->sleep(ring.bell->announce(), deadline_in(2ms)), WaitStatus::timeout);
  Bell* const bells[] = {ring.bell.get()};
  const std::uint32_t announced[] = {ring.bell->announce()};
  WaitStatus status = WaitStatus::ready;
  const MonoTime deadline = deadline_in(3ms);
  while ((status = Bell::sleep_any(bells, announced, deadline)) == WaitStatus::ready) {
  }
  EXPECT_EQ(status, WaitStatus::timeout);
}

// A writer may have died between publishing and ringing.
TEST(Bell, SleepersCheckTheRingThoughNoWriterRings) {
  const TestRing ring(8, 4);
  for (const MonoTime deadline : {kNever, deadline_in(std::chrono::hours(1))}) {
    const MonoTime begin = MonoClock::now();
    EXPECT_EQ(ring.bell->sleep(ring.bell->announce(), deadline, 5ms), WaitStatus::ready);
    EXPECT_GE(MonoClock::now() - begin, 5ms);
  }
}

TEST(SleepTimes, BeginWithTwoCyclesAndGrowToASecond) {
  const auto times_of = [](Duration cycle) {
    SleepTimes times(cycle);
    MonoTime now{1h};
    std::vector<Duration> first;
    for (int i = 0; i < 4; ++i) now += first.emplace_back(times.next(now));
    return first;
  };
  using Times = std::vector<Duration>;
  EXPECT_EQ(times_of(10ms), (Times{20ms, 20ms, 40ms, 80ms}));
  EXPECT_EQ(times_of(200ms), (Times{400ms, 400ms, 800ms, 1s}));
  for (const Duration strange : {Duration::min(), Duration(0), Duration(1)}) {
    EXPECT_EQ(times_of(strange), (Times{2ms, 2ms, 4ms, 8ms}));
  }
  EXPECT_EQ(times_of(Duration::max()), (Times{1s, 1s, 1s, 1s}));
}

TEST(SleepTimes, DoNotGrowWhenSleepsEndEarly) {
  SleepTimes times(1ms);
  for (int i = 0; i < 100; ++i) EXPECT_EQ(times.next(MonoTime{1h}), 2ms);
}

TEST(Bell, SleepReturnsWhenItRangSinceTheAnnouncement) {
  const TestRing ring(8, 4);
  const std::uint32_t announced = ring.bell->announce();
  RingWriter writer = ring.writer();
  writer.write(payload_for(0, 8), {}, 0ns);
  EXPECT_EQ(ring.bell->sleep(announced, deadline_in(std::chrono::hours(1))), WaitStatus::ready);
}

TEST(RingWriter, RingsTheDoorbellOnlyWhileItIsArmed) {
  const TestRing ring(8, 4);
  const UniqueFd doorbell(::eventfd(0, EFD_CLOEXEC | EFD_NONBLOCK));
  RingWriter writer = ring.writer(doorbell.get());
  std::uint64_t count = 0;
  writer.write(payload_for(0, 8), {}, 0ns);
  EXPECT_EQ(::read(doorbell.get(), &count, 8), -1);
  ring.mapping->header().doorbell_armed = 1;
  writer.write(payload_for(1, 8), {}, 0ns);
  writer.write(payload_for(2, 8), {}, 0ns);
  ASSERT_EQ(::read(doorbell.get(), &count, 8), 8);
  EXPECT_EQ(count, 2u);
  ring.mapping->header().doorbell_armed = 0;
  writer.write(payload_for(3, 8), {}, 0ns);
  EXPECT_EQ(::read(doorbell.get(), &count, 8), -1);
}

TEST(SlotTable, IndexEqualsTheRemainderForAllDepthsAndTids) {
  std::mt19937_64 random(20261121);
  for (int i = 0; i < 300; ++i) {
    const std::uint64_t depth = i < 100 ? 2 + static_cast<std::uint64_t>(i) : 2 + random() % 20'000;
    const TestRing ring(1, depth);
    const SlotTable slots(*ring.mapping);
    for (int j = 0; j < 200; ++j) {
      const std::uint64_t near = random() % (1ULL << (1 + random() % 62));
      const auto tid = static_cast<Tid>(j % 2 ? near : near / depth * depth);
      ASSERT_EQ(slots.index(tid), static_cast<std::uint64_t>(tid) % depth) << tid << " % " << depth;
    }
  }
}

}  // namespace
}  // namespace dssm::ring
