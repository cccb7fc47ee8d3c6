// SPDX-License-Identifier: Apache-2.0
//
// A mirror's ring takes the owner's samples, in their order and the newest first, and never shows
// one that is torn.
#include "daemon/remote/mirror_ring.hpp"

#include <gtest/gtest.h>

#include <cstring>

#include "daemon/link/sample_pump.hpp"
#include "tests/unit/daemon/daemon_fixtures.hpp"

namespace dssm::daemon {
namespace {

constexpr std::uint64_t kDepth = 16;

std::vector<std::byte> payload_of(Tid tid) {
  return std::vector<std::byte>(24, static_cast<std::byte>(tid));
}

class MirrorRingTest : public testing::Test {
 protected:
  MemoryBudgets budgets{1 << 20, {}};
  MemoryBudget& budget = budgets.total();
  std::shared_ptr<Stream> stream = Stream::create({.id = {"odometry", 0, "pc2"},
                                                   .type = odometry_type(),
                                                   .depth = kDepth,
                                                   .cycle = std::chrono::milliseconds(10),
                                                   .purpose = Purpose::mirror,
                                                   .incarnation = 7},
                                                  budgets)
                                       .value();
  std::unique_ptr<MirrorRing> ring = MirrorRing::open(stream, budget).value();
  ring::RingReader reader{stream->mapping()};

  static wire::IncomingSample incoming(Tid tid) {
    return {0, {tid, time_from_ns(1000 + tid), Duration(tid), 24}};
  }
  Result<void> take(Tid tid, bool torn = false) {
    const wire::IncomingSample sample = incoming(tid);
    Result<std::byte*> place = ring->begin_untrusted(sample);
    if (!place) return std::move(place).error();
    std::memcpy(*place, payload_of(tid).data(), 24);
    ring->end(sample, torn);
    return {};
  }
  // The sample that it asks the owner for; kNoTid: the oldest.
  Tid wanted() const {
    net::Subscribe request;
    ring->resume(true, true, request);
    return request.from_oldest() ? kNoTid : request.from_tid();
  }
  ReadStatus read(Tid tid) {
    std::vector<std::byte> payload(24);
    SampleInfo info;
    const ReadStatus status = reader.read(tid, payload, info);
    if (status == ReadStatus::ok) {
      EXPECT_EQ(info.tid, tid);
      EXPECT_EQ(to_ns(info.time), 1000 + tid);
      EXPECT_EQ(to_ns(info.clock_error), tid);
      EXPECT_EQ(payload, payload_of(tid));
    }
    return status;
  }
};

TEST_F(MirrorRingTest, RepeatsTheOwnersTidsWhereverTheyBegin) {
  EXPECT_EQ(wanted(), kNoTid) << "nothing known: the oldest is wanted";
  ASSERT_TRUE(ring->on_subscribed_untrusted(1000, false, 0));
  for (Tid tid = 1000; tid < 1010; ++tid) ASSERT_TRUE(take(tid));
  EXPECT_EQ(reader.oldest(), 1000);
  EXPECT_EQ(reader.newest(), 1009);
  for (Tid tid = 1000; tid < 1010; ++tid) EXPECT_EQ(read(tid), ReadStatus::ok);
  EXPECT_EQ(wanted(), 1010);
  EXPECT_EQ(ring->gap_samples(), 0u);
  EXPECT_EQ(ring->received_samples(), 10u);
  EXPECT_EQ(ring->received_bytes(), 240u);
}

TEST_F(MirrorRingTest, NeverShowsATornSampleAndCountsItOnce) {
  ASSERT_TRUE(ring->on_subscribed_untrusted(0, false, 0));
  ASSERT_TRUE(take(0));
  ASSERT_TRUE(take(1, true));
  EXPECT_EQ(reader.newest(), 0);
  ASSERT_TRUE(take(2));
  EXPECT_EQ(reader.newest(), 2);
  EXPECT_EQ(reader.oldest(), 2) << "the window has no holes";
  EXPECT_NE(read(1), ReadStatus::ok);
  EXPECT_EQ(ring->gap_samples(), 1u);
}

TEST_F(MirrorRingTest, CountsATornSampleThatIsReportedAsAGapOnce) {
  ASSERT_TRUE(ring->on_subscribed_untrusted(0, false, 0));
  ASSERT_TRUE(take(0));
  ASSERT_TRUE(take(1, true));
  ASSERT_TRUE(ring->on_gap_untrusted(1, 1));
  ASSERT_TRUE(take(2));
  EXPECT_EQ(ring->gap_samples(), 1u);
}

TEST_F(MirrorRingTest, CountsReportedAndUnreportedGapsAlike) {
  ASSERT_TRUE(ring->on_subscribed_untrusted(0, false, 0));
  ASSERT_TRUE(take(0));
  ASSERT_TRUE(ring->on_gap_untrusted(1, 9));
  EXPECT_EQ(ring->gap_samples(), 9u) << "before anything comes behind it";
  EXPECT_EQ(wanted(), 10) << "a cut now resumes behind the gap";
  ASSERT_TRUE(take(10));
  ASSERT_TRUE(take(15));  // untold
  EXPECT_EQ(ring->gap_samples(), 13u);
}

TEST_F(MirrorRingTest, CountsWhatTheOwnerLostWhileTheLinkWasCut) {
  ASSERT_TRUE(ring->on_subscribed_untrusted(0, false, 0));
  ASSERT_TRUE(take(0));
  ASSERT_TRUE(
      ring->on_subscribed_untrusted(100, false, 0));  // after a reconnect: the oldest it still has
  ASSERT_TRUE(take(100));
  EXPECT_EQ(ring->gap_samples(), 99u);
}

TEST_F(MirrorRingTest, KeepsTheWindowWholeWhileASampleAfterAGapArrives) {
  ASSERT_TRUE(ring->on_subscribed_untrusted(0, false, 0));
  for (Tid tid = 0; tid < 20; ++tid) ASSERT_TRUE(take(tid));
  for (const Tid behind : {22, 28, 33, 35}) {  // their slots hold 6, 12, 17 and the newest
    const wire::IncomingSample sample = incoming(behind);
    ASSERT_TRUE(ring->begin_untrusted(sample));
    for (Tid tid = reader.oldest(); tid <= reader.newest(); ++tid) {
      EXPECT_EQ(read(tid), ReadStatus::ok) << tid << " while " << behind << " arrives";
    }
    ring->end(sample, true);
  }
  ASSERT_TRUE(take(35));
  EXPECT_EQ(reader.oldest(), 35);
  EXPECT_EQ(read(35), ReadStatus::ok);
  EXPECT_EQ(ring->gap_samples(), 15u);
}

TEST_F(MirrorRingTest, DoesNotTakeWhatWasCutOffForTheNextSample) {
  ASSERT_TRUE(ring->on_subscribed_untrusted(0, false, 0));
  for (Tid tid = 0; tid < 20; ++tid) ASSERT_TRUE(take(tid));
  const std::uint64_t used = budget.used();
  ASSERT_TRUE(ring->begin_untrusted(incoming(28)));  // aside; then the connection breaks
  EXPECT_EQ(budget.used(), used + 24);
  ASSERT_TRUE(take(20));  // the owner has it still
  EXPECT_EQ(read(20), ReadStatus::ok);
  EXPECT_EQ(budget.used(), used);
  EXPECT_EQ(ring->gap_samples(), 0u);
}

TEST_F(MirrorRingTest, ReceivesInPlaceWhenThereIsNoMemoryToSetAside) {
  ASSERT_TRUE(ring->on_subscribed_untrusted(0, false, 0));
  for (Tid tid = 0; tid < 20; ++tid) ASSERT_TRUE(take(tid));
  const MemoryShare rest = budget.take(budget.limit() - budget.used()).value();
  ASSERT_TRUE(take(28));
  EXPECT_EQ(read(28), ReadStatus::ok);
}

TEST_F(MirrorRingTest, RefusesTidsThatDoNotRise) {
  EXPECT_FALSE(ring->on_subscribed_untrusted(-1, false, 0));
  EXPECT_FALSE(ring->on_subscribed_untrusted(channel::kMaxTid + 1, false, 0));
  ASSERT_TRUE(ring->on_subscribed_untrusted(5, false, 0));
  ASSERT_TRUE(take(5));
  EXPECT_EQ(take(5).error().code, Errc::protocol);
  EXPECT_EQ(take(4).error().code, Errc::protocol);
  EXPECT_EQ(take(channel::kMaxTid + 1).error().code, Errc::protocol);
  EXPECT_EQ(ring->on_gap_untrusted(3, 2).error().code, Errc::protocol);
  EXPECT_EQ(ring->on_gap_untrusted(-1, 20).error().code, Errc::protocol);
  EXPECT_EQ(ring->on_gap_untrusted(0, ~std::uint64_t{0}).error().code, Errc::protocol);
  EXPECT_EQ(ring->gap_samples(), 0u);
}

TEST_F(MirrorRingTest, ContinuesAfterWhatAnEarlierDssmdReceived) {
  ASSERT_TRUE(ring->on_subscribed_untrusted(0, false, 0));
  for (Tid tid = 0; tid < 40; ++tid) ASSERT_TRUE(take(tid));
  ASSERT_TRUE(ring->begin_untrusted(incoming(40)));  // dies here
  ring = MirrorRing::open(stream, budget).value();
  EXPECT_EQ(wanted(), 40);
  EXPECT_EQ(read(39), ReadStatus::ok);
  ASSERT_TRUE(take(40));
  EXPECT_EQ(read(40), ReadStatus::ok);
  EXPECT_EQ(ring->gap_samples(), 0u);
}

TEST_F(MirrorRingTest, WakesSleepersOncePerBatch) {
  auto bell = stream->map_bell().value();
  ASSERT_TRUE(ring->on_subscribed_untrusted(0, false, 0));
  const std::uint32_t announced = bell->announce();
  ASSERT_TRUE(take(0));
  ASSERT_TRUE(take(1));
  EXPECT_EQ(bell->announce(), announced) << "not before the batch is complete";
  ring->wake();
  EXPECT_NE(bell->announce(), announced);
  const std::uint32_t again = bell->announce();
  ring->wake();
  EXPECT_EQ(bell->announce(), again) << "nothing new came";
}

// --- the newest first

class NewestFirstTest : public MirrorRingTest {
 protected:
  net::Subscribe request(bool with_history = true) const {
    net::Subscribe request;
    ring->resume(true, with_history, request);
    return request;
  }
  ReadStatus find(std::int64_t ns) const {
    Tid tid = kNoTid;
    return reader.find(time_from_ns(ns), tid);
  }
  Tid found(std::int64_t ns) const {
    Tid tid = kNoTid;
    EXPECT_EQ(reader.find(time_from_ns(ns), tid), ReadStatus::ok);
    return tid;
  }
};

TEST_F(NewestFirstTest, WhatIsHereAlreadyIsNotAskedForAgain) {
  request();
  ASSERT_TRUE(ring->on_subscribed_untrusted(2, true, 0));
  ASSERT_TRUE(take(9));
  for (const Tid tid : {2, 3, 5}) ASSERT_TRUE(take(tid));
  ASSERT_TRUE(ring->on_gap_untrusted(4, 1));
  ring->wake();
  const net::Subscribe again = request();
  EXPECT_EQ(again.from_tid(), 6);
  EXPECT_EQ(again.held_from(), 9);
  EXPECT_EQ(again.held_to(), 10);
  EXPECT_EQ(again.backlog_from(), 9) << "those before were written when nobody was here";
  ASSERT_TRUE(ring->on_subscribed_untrusted(6, true, 0));
  for (const Tid tid : {10, 11, 14}) ASSERT_TRUE(take(tid));
  EXPECT_EQ(request().from_tid(), 6);
  EXPECT_EQ(request().backlog_from(), 12) << "what is missing of those since then";
  EXPECT_EQ(read(3), ReadStatus::ok);
  ring = MirrorRing::open(stream, budget).value();
  EXPECT_EQ(request().backlog_from(), 6) << "no longer known: all that is missing";
}

TEST_F(NewestFirstTest, TheNewestIsReadableBeforeThoseThatCameBeforeIt) {
  EXPECT_TRUE(request().newest_first());
  ASSERT_TRUE(ring->on_subscribed_untrusted(2, true, 0));
  ASSERT_TRUE(take(9));
  EXPECT_EQ(reader.newest(), 9);
  EXPECT_EQ(reader.oldest(), 2);
  EXPECT_EQ(read(9), ReadStatus::ok);
  EXPECT_EQ(read(8), ReadStatus::arriving);
  EXPECT_EQ(read(1), ReadStatus::too_old);
  EXPECT_EQ(find(1009), ReadStatus::ok);
  EXPECT_EQ(find(1008), ReadStatus::arriving);
  for (const Tid tid : {7, 8}) ASSERT_TRUE(take(tid));
  ring->wake();
  EXPECT_EQ(find(1007), ReadStatus::ok);
  EXPECT_EQ(find(1006), ReadStatus::arriving);
  ASSERT_TRUE(take(10));
  for (Tid tid = 2; tid < 7; ++tid) ASSERT_TRUE(take(tid));
  ring->wake();
  for (Tid tid = 2; tid <= 10; ++tid) EXPECT_EQ(read(tid), ReadStatus::ok);
  EXPECT_EQ(find(1002), ReadStatus::ok);
  EXPECT_EQ(find(1001), ReadStatus::too_old);
  EXPECT_EQ(ring->gap_samples(), 0u);
  EXPECT_EQ(ring->received_samples(), 9u);
}

TEST_F(NewestFirstTest, AsksForTheHoleAfterACutAndAfterADssmdThatDied) {
  ASSERT_TRUE(ring->on_subscribed_untrusted(0, true, 0));
  for (const Tid tid : {0, 1, 8, 6, 7, 9}) ASSERT_TRUE(take(tid));
  ring->wake();
  for (const bool died : {false, true}) {
    if (died) {
      ASSERT_TRUE(ring->begin_untrusted(incoming(5)));
      ring = MirrorRing::open(stream, budget).value();
    }
    EXPECT_EQ(request().from_tid(), 2);
    EXPECT_EQ(request().held_from(), 6);
    EXPECT_EQ(request().held_to(), 10);
    ASSERT_TRUE(ring->on_subscribed_untrusted(2, true, 0));
  }
  ASSERT_TRUE(take(12));
  for (const Tid tid : {10, 11, 2, 3, 4, 5}) ASSERT_TRUE(take(tid));
  ring->wake();
  for (Tid tid = 0; tid <= 12; ++tid) EXPECT_EQ(read(tid), ReadStatus::ok);
  EXPECT_TRUE(reader.hole().is_empty());
  EXPECT_EQ(request().from_tid(), 13);
}

TEST_F(NewestFirstTest, HistoryComesWhenItIsWanted) {
  EXPECT_TRUE(request(false).from_newest());
  ASSERT_TRUE(ring->on_subscribed_untrusted(9, true, 2));
  for (const Tid tid : {9, 10}) ASSERT_TRUE(take(tid));
  ring->wake();
  EXPECT_EQ(reader.oldest(), 2);
  EXPECT_EQ(read(9), ReadStatus::ok);
  EXPECT_EQ(read(8), ReadStatus::arriving);
  EXPECT_EQ(find(1008), ReadStatus::arriving);
  // After a cut the newest one comes first again, and what was missed is history, too.
  EXPECT_TRUE(request(false).from_newest());
  EXPECT_EQ(request(false).held_from(), 9);
  EXPECT_EQ(request(false).held_to(), 11);
  ASSERT_TRUE(ring->on_subscribed_untrusted(13, true, 4));
  ASSERT_TRUE(take(13));
  EXPECT_EQ(read(12), ReadStatus::arriving);
  EXPECT_EQ(read(3), ReadStatus::lost) << "the owner no longer holds it";
  EXPECT_EQ(request().from_tid(), 4);
  EXPECT_EQ(request().held_from(), 13);
  EXPECT_EQ(request().held_to(), 14);
  ASSERT_TRUE(ring->on_subscribed_untrusted(4, true, 4));
  for (const Tid tid : {4, 5, 6, 7, 8, 9, 10, 11, 12}) ASSERT_TRUE(take(tid));
  ring->wake();
  EXPECT_TRUE(reader.hole().is_empty());
  for (Tid tid = 4; tid <= 13; ++tid) EXPECT_EQ(found(1000 + tid), tid);
  EXPECT_EQ(ring->gap_samples(), 0u) << "nobody wanted those that are lost";
}

TEST_F(NewestFirstTest, HistoryThatNobodyWantsIsNotMissed) {
  EXPECT_TRUE(request(false).from_newest());
  ASSERT_TRUE(ring->on_subscribed_untrusted(9, true, 0));
  for (Tid tid = 9; tid < 60; ++tid) ASSERT_TRUE(take(tid));
  ring->wake();
  EXPECT_EQ(read(8), ReadStatus::too_old);
  EXPECT_EQ(find(1008), ReadStatus::too_old) << "the hole has left the window";
  EXPECT_EQ(ring->gap_samples(), 0u);
  ring->end_filling();
  EXPECT_EQ(ring->gap_samples(), 0u);
}

TEST_F(NewestFirstTest, WhatIsPassedOverAndLostIsMissedAlsoWithoutHistory) {
  EXPECT_TRUE(request(false).from_newest());
  ASSERT_TRUE(ring->on_subscribed_untrusted(9, true, 2));
  for (const Tid tid : {9, 12}) ASSERT_TRUE(take(tid));
  ASSERT_TRUE(ring->on_gap_untrusted(10, 2));
  ring->wake();
  EXPECT_EQ(read(10), ReadStatus::lost);
  EXPECT_EQ(ring->gap_samples(), 2u);
  ASSERT_TRUE(take(15));
  ring->end_filling();
  EXPECT_EQ(ring->gap_samples(), 4u) << "also 13 and 14, but none before 9";
}

// The owner's ring holds more than this one.
TEST_F(NewestFirstTest, WhatHasNoPlaceInAShorterRingIsNotAskedFor) {
  EXPECT_TRUE(request(false).from_newest());
  ASSERT_TRUE(ring->on_subscribed_untrusted(1000, true, 0));
  EXPECT_EQ(request().from_tid(), 1000 - 14);
  ASSERT_TRUE(take(1000));
  ASSERT_TRUE(ring->on_subscribed_untrusted(1000 - 14, true, 0));
  for (Tid tid = 1000 - 14; tid < 1000; ++tid) ASSERT_TRUE(take(tid));
  ring->wake();
  EXPECT_TRUE(reader.hole().is_empty());
  EXPECT_EQ(ring->gap_samples(), 0u);
  // After a cut.
  EXPECT_TRUE(request(false).from_newest());
  ASSERT_TRUE(ring->on_subscribed_untrusted(2000, true, 0));
  EXPECT_EQ(request().from_tid(), 2000 - 14);
  ASSERT_TRUE(take(2000));
  EXPECT_EQ(ring->gap_samples(), 0u) << "nobody had asked for 1001 to 1985";
}

TEST_F(NewestFirstTest, WhatIsPassedOverAndHasNoPlaceAnyMoreIsMissed) {
  ASSERT_TRUE(ring->on_subscribed_untrusted(0, true, 0));
  ASSERT_TRUE(take(0));
  ASSERT_TRUE(ring->on_gap_untrusted(10, 5));
  ASSERT_TRUE(take(100));
  EXPECT_EQ(ring->gap_samples(), 85u) << "1 to 85, 10 to 14 of them once";
  EXPECT_EQ(reader.oldest(), 86);
}

TEST_F(NewestFirstTest, HistoryMayBeWantedBeforeTheNewestOneHasCome) {
  EXPECT_TRUE(request(false).from_newest());
  ASSERT_TRUE(ring->on_subscribed_untrusted(9, true, 2));
  EXPECT_EQ(request().from_tid(), 2);
  ASSERT_TRUE(take(9));  // of the first subscription
  ASSERT_TRUE(ring->on_subscribed_untrusted(2, true, 2));
  for (const Tid tid : {9, 2, 3, 4, 5, 6, 7, 8}) ASSERT_TRUE(take(tid));
  ring->wake();
  for (Tid tid = 2; tid <= 9; ++tid) EXPECT_EQ(found(1000 + tid), tid);
}

TEST_F(NewestFirstTest, WhatTheOwnerLostIsNoLongerAwaited) {
  ASSERT_TRUE(ring->on_subscribed_untrusted(0, true, 0));
  for (const Tid tid : {0, 1, 8}) ASSERT_TRUE(take(tid));
  ASSERT_TRUE(ring->on_gap_untrusted(2, 3));
  EXPECT_EQ(ring->gap_samples(), 3u);
  EXPECT_EQ(read(4), ReadStatus::lost);
  EXPECT_EQ(read(5), ReadStatus::arriving);
  ASSERT_TRUE(take(7));
  ASSERT_TRUE(ring->on_gap_untrusted(5, 2));
  ring->wake();
  EXPECT_EQ(ring->gap_samples(), 5u);
  EXPECT_TRUE(reader.hole().is_empty());
  for (const Tid tid : {0, 1, 7, 8}) {
    EXPECT_EQ(read(tid), ReadStatus::ok);
    EXPECT_EQ(found(1000 + tid), tid);
  }
  EXPECT_EQ(found(1006), 1) << "the newest one that is here";
}

TEST_F(NewestFirstTest, WhatTheNetworkCannotCarryIsLostBetweenThoseThatAreHere) {
  ASSERT_TRUE(ring->on_subscribed_untrusted(0, true, 0));
  ASSERT_TRUE(take(0));
  for (const Tid newest : {3, 6, 9}) {
    ASSERT_TRUE(ring->on_gap_untrusted(newest - 2, 2));
    ASSERT_TRUE(take(newest));
    ring->wake();
    EXPECT_TRUE(reader.hole().is_empty());
  }
  EXPECT_EQ(ring->gap_samples(), 6u);
  EXPECT_EQ(ring->recent().samples, 10u);
  EXPECT_EQ(ring->recent().lost, 6u);
  EXPECT_EQ(reader.oldest(), 0);
  for (Tid tid = 0; tid < 10; ++tid) {
    EXPECT_EQ(read(tid), tid % 3 == 0 ? ReadStatus::ok : ReadStatus::lost);
    EXPECT_EQ(found(1000 + tid), tid / 3 * 3);
  }
  // Some lost, some still to come, and one that it wants to send nevertheless.
  ASSERT_TRUE(ring->on_gap_untrusted(10, 1));
  ASSERT_TRUE(take(13));
  EXPECT_EQ(read(10), ReadStatus::lost);
  EXPECT_EQ(read(11), ReadStatus::arriving);
  for (const Tid tid : {10, 11, 12}) ASSERT_TRUE(take(tid));
  ring->wake();
  EXPECT_EQ(read(10), ReadStatus::lost);
  EXPECT_EQ(found(1012), 12);
  // More than the ring holds.
  ASSERT_TRUE(ring->on_gap_untrusted(14, 100));
  ASSERT_TRUE(take(114));
  EXPECT_EQ(reader.oldest(), 114);
}

TEST_F(NewestFirstTest, WhatTheOwnerNoLongerHasAfterACutIsLost) {
  ASSERT_TRUE(ring->on_subscribed_untrusted(0, true, 0));
  ASSERT_TRUE(take(0));
  ASSERT_TRUE(ring->on_subscribed_untrusted(3, true, 0));
  ASSERT_TRUE(take(6));
  EXPECT_EQ(ring->gap_samples(), 2u);
  EXPECT_EQ(read(2), ReadStatus::lost);
  EXPECT_EQ(read(3), ReadStatus::arriving);
}

TEST_F(NewestFirstTest, DropsWhatHasNoPlaceAnyMore) {
  ASSERT_TRUE(ring->on_subscribed_untrusted(0, true, 0));
  for (const Tid tid : {3, 25}) ASSERT_TRUE(take(tid));
  for (const Tid late : {3, 1, 9}) ASSERT_TRUE(take(late));  // the window begins at 11
  EXPECT_EQ(read(25), ReadStatus::ok) << "9 has its slot";
  EXPECT_EQ(read(9), ReadStatus::too_old);
  ASSERT_TRUE(take(24));
  ASSERT_TRUE(take(24)) << "twice";
  EXPECT_EQ(read(24), ReadStatus::ok);
  const MemoryShare rest = budget.take(budget.limit() - budget.used()).value();
  EXPECT_TRUE(take(9)) << "that needs no memory";
}

TEST_F(NewestFirstTest, ALossThatCannotBeIsBounded) {
  ASSERT_TRUE(ring->on_subscribed_untrusted(0, true, 0));
  ASSERT_TRUE(take(channel::kMaxTid));
  EXPECT_FALSE(ring->on_gap_untrusted(0, ~std::uint64_t{0}));
  ASSERT_TRUE(ring->on_gap_untrusted(0, channel::kMaxTid)) << "and it does not take for ever";
  EXPECT_EQ(read(channel::kMaxTid), ReadStatus::ok);
}

}  // namespace
}  // namespace dssm::daemon
