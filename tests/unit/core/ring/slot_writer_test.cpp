// SPDX-License-Identifier: Apache-2.0
//
// SlotWriter as mirrors use it: rings that repeat another ring's tids, begin anywhere, and cross
// gaps.
#include "core/ring/slot_writer.hpp"

#include <algorithm>
#include <map>
#include <random>
#include <thread>

#include "core/ring/copy.hpp"
#include "tests/unit/core/ring/test_ring.hpp"

namespace dssm::ring {
namespace {

void put(const SlotWriter& mirror, Tid tid, std::int64_t time_ns, std::size_t bytes) {
  const std::vector<std::byte> payload = payload_for(tid, bytes);
  copy_in(mirror.begin(tid), payload.data(), payload.size());
  mirror.publish({tid, time_from_ns(time_ns), Duration(tid % 100), bytes});
}

TEST(SlotWriter, BeginsWithAnyTid) {
  const TestRing ring(8, 13);
  const RingReader reader = ring.reader();
  const SlotWriter mirror(*ring.mapping);
  EXPECT_EQ(mirror.newest(), kNoTid);
  for (Tid tid = 5000; tid < 5003; ++tid) put(mirror, tid, 100 * tid, 8);
  EXPECT_EQ(reader.newest(), 5002);
  EXPECT_EQ(reader.oldest(), 5000);
  std::vector<std::byte> out(8);
  SampleInfo info;
  EXPECT_EQ(reader.read(4999, out, info), ReadStatus::too_old);
  ASSERT_EQ(reader.read(5000, out, info), ReadStatus::ok);
  EXPECT_EQ(out, payload_for(5000, 8));
  EXPECT_EQ(info.tid, 5000);
  EXPECT_EQ(to_ns(info.time), 500'000);
  EXPECT_EQ(info.clock_error, Duration(0));
  Tid found = kNoTid;
  EXPECT_EQ(reader.find(time_from_ns(499'999), found), ReadStatus::too_old);
  EXPECT_EQ(reader.find(time_from_ns(500'150), found), ReadStatus::ok);
  EXPECT_EQ(found, 5001);
}

// The model: what was put since the last gap and still fits into the ring.
TEST(SlotWriter, KeepsNoHolesWhateverIsLeftOut) {
  const std::uint64_t seed = std::random_device{}();
  std::mt19937_64 random(seed);
  for (const std::uint64_t depth : {2, 3, 13, 100}) {
    SCOPED_TRACE(testing::Message() << "depth " << depth << ", seed " << seed);
    const TestRing ring(16, depth);
    const RingReader reader = ring.reader();
    const SlotWriter mirror(*ring.mapping);
    std::map<Tid, std::int64_t> model;
    Tid tid = static_cast<Tid>(random() % 1000);
    std::int64_t time_ns = 1'000'000;
    std::vector<std::byte> out(16);
    for (int i = 0; i < 2000; ++i) {
      const bool gap = random() % 20 == 0;
      if (gap) tid += 1 + static_cast<Tid>(random() % (3 * depth));
      if (gap) model.clear();
      time_ns += random() % 10 ? 1000 : -static_cast<std::int64_t>(random() % 30'000);
      put(mirror, tid, time_ns, 16);
      model[tid] = time_ns;
      while (model.size() > depth - 1) model.erase(model.begin());
      ASSERT_EQ(reader.newest(), tid);
      ASSERT_EQ(reader.oldest(), model.begin()->first);
      for (const auto& [each, at_ns] : model) {
        SampleInfo info;
        ASSERT_EQ(reader.read(each, out, info), ReadStatus::ok);
        ASSERT_EQ(out, payload_for(each, 16));
        ASSERT_EQ(to_ns(info.time), at_ns);
      }
      for (int q = 0; q < 8; ++q) {
        const std::int64_t t = time_ns - 20'000 + static_cast<std::int64_t>(random() % 40'000);
        Tid wanted = kNoTid, found = kNoTid;
        for (const auto& [each, at_ns] : model) {
          if (at_ns <= t) wanted = each;
        }
        ASSERT_EQ(reader.find(time_from_ns(t), found),
                  wanted == kNoTid ? ReadStatus::too_old : ReadStatus::ok);
        ASSERT_EQ(found, wanted);
      }
      ++tid;
    }
  }
}

TEST(SlotWriter, ShowsNothingOfASampleThatIsNotPublished) {
  const TestRing ring(8, 4);
  const RingReader reader = ring.reader();
  const SlotWriter mirror(*ring.mapping);
  put(mirror, 7, 700, 8);
  mirror.begin(8)[0] = std::byte{0xff};
  EXPECT_EQ(reader.newest(), 7);
  put(mirror, 9, 900, 8);  // 8 was void
  EXPECT_EQ(reader.newest(), 9);
  EXPECT_EQ(reader.oldest(), 9);
}

// A dssmd that dies between announcing a gap and publishing the sample after it.
TEST(SlotWriter, RepairsWhatADeadDssmdLeft) {
  const TestRing ring(8, 13);
  const RingReader reader = ring.reader();
  {
    const SlotWriter mirror(*ring.mapping);
    for (Tid tid = 20; tid < 24; ++tid) put(mirror, tid, 100 * tid, 8);
    mirror.begin(50);
    ring.mapping->header().first.store(50);
    ring.mapping->header().run_start.store(50);
  }
  std::vector<std::byte> out(8);
  SampleInfo info;
  EXPECT_EQ(reader.oldest(), 23);
  EXPECT_EQ(reader.read_newest(out, info), ReadStatus::ok);
  Tid found = kNoTid;
  EXPECT_EQ(reader.find(time_from_ns(5000), found), ReadStatus::ok);
  EXPECT_EQ(found, 23);
  const SlotWriter next(*ring.mapping);
  next.recover();
  put(next, 24, 2400, 8);
  EXPECT_EQ(reader.newest(), 24);
  EXPECT_EQ(reader.read(23, out, info), ReadStatus::ok);
  EXPECT_EQ(reader.find(time_from_ns(2350), found), ReadStatus::ok);
  EXPECT_EQ(found, 23);
}

// A program that may write can mark any slots, and say that the lock's holder died.
TEST(SlotWriter, DoesNotFollowMarksOfLostSamplesWhereThereAreNone) {
  const TestRing ring(8, 13);
  RingWriter writer = ring.writer();
  writer.write(payload_for(0, 8), time_from_ns(1), Duration(0));
  const SlotTable slots(*ring.mapping);
  for (Tid tid = 1; tid < 12; ++tid) slots.slot(tid).sequence = lost_sequence(tid);
  SlotWriter(*ring.mapping).recover();
  for (Tid tid = 1; tid < 12; ++tid) EXPECT_EQ(slots.slot(tid).sequence, lost_sequence(tid));
}

TEST(SlotWriter, NeverGivesConcurrentReadersAnotherSample) {
  const TestRing ring(64, 17);
  const RingReader reader = ring.reader();
  std::atomic<bool> done = false;
  std::thread filler([&] {
    const SlotWriter mirror(*ring.mapping);
    std::mt19937_64 random(1);
    Tid tid = 100;
    for (int i = 0; i < 20'000; ++i, ++tid) {
      if (random() % 8 == 0) tid += static_cast<Tid>(random() % 40);
      put(mirror, tid, 1000 * tid, 64);
    }
    done = true;
  });
  std::vector<std::byte> out(64);
  std::uint64_t read = 0;
  while (!done || read == 0) {
    SampleInfo info;
    if (reader.read_newest(out, info) == ReadStatus::ok) {
      ++read;
      ASSERT_EQ(out, payload_for(info.tid, 64));
    }
    const Tid wanted = reader.newest() - 3;
    Tid found = kNoTid;
    if (wanted > 0 && reader.find(time_from_ns(1000 * wanted), found) == ReadStatus::ok) {
      ASSERT_LE(found, wanted);
      if (reader.read(found, out, info) == ReadStatus::ok) {
        ASSERT_EQ(info.time, time_from_ns(1000 * found));
        ASSERT_EQ(out, payload_for(found, 64));
      }
    }
  }
  filler.join();
}

TEST(RingWriter, DoesNotWaitForAnotherWriterWhenItOnlyTries) {
  const TestRing ring(8, 4);
  RingWriter held = ring.writer();
  ASSERT_NE(held.begin(), nullptr);
  // Another thread: the lock belongs to this one.
  std::thread([&] {
    RingWriter writer = ring.writer();
    EXPECT_EQ(writer.try_publish({5, 0}, payload_for(0, 8), time_from_ns(1), Duration(0)), kNoTid);
  }).join();
  held.cancel();
  std::thread([&] {
    RingWriter writer = ring.writer();
    EXPECT_EQ(writer.try_publish({5, 0}, payload_for(0, 8), time_from_ns(1), Duration(0)), 0);
  }).join();
}

}  // namespace
}  // namespace dssm::ring
