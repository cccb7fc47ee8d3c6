// SPDX-License-Identifier: Apache-2.0
#include "core/clock/sync_chain.hpp"

#include <gtest/gtest.h>

namespace dssm::clock {
namespace {

using namespace std::chrono_literals;

constexpr ClockId kFirst{1}, kSecond{2}, kThird{3}, kStranger{4};

// A clock whose samples are stamped against the last link.
SyncChain standing(std::vector<ClockLink> chain) {
  SyncChain made;
  made.anchor = chain.back().clock;
  made.bound = chain.back().bound;
  made.chain = std::move(chain);
  return made;
}

TEST(SyncChain, ClocksWithOneReferenceAreAsFarApartAsBothBoundsSay) {
  const SyncChain pc2 = standing({{kSecond, 1us}, {kFirst, 100us}});
  const SyncChain pc3 = standing({{kThird, 2us}, {kFirst, 30us}});
  EXPECT_EQ(distance(pc2, pc3), 130us);
  EXPECT_EQ(distance(pc3, pc2), 130us);
}

TEST(SyncChain, AClockAndItsReferenceAreApartByBothDistancesFromTheReferencesTime) {
  const SyncChain pc1 = standing({{kFirst, 5us}});
  const SyncChain pc2 = standing({{kSecond, 1us}, {kFirst, 100us}});
  EXPECT_EQ(distance(pc1, pc2), 105us);
}

TEST(SyncChain, TheShortestWayCounts) {
  // pc2 follows pc1, which is gone, and pc3 follows pc2: the way by pc2 does not grow.
  const SyncChain pc2 = standing({{kSecond, 1us}, {kFirst, 900us}});
  const SyncChain pc3 = standing({{kThird, 0us}, {kSecond, 40us}, {kFirst, 940us}});
  EXPECT_EQ(distance(pc2, pc3), 41us);
}

TEST(SyncChain, WithoutACommonClockOnlyUtcHelps) {
  SyncChain one = standing({{kFirst, 0us}});
  SyncChain other = standing({{kStranger, 0us}});
  EXPECT_EQ(distance(one, other), kUnknownClockError);
  one.root_bound = 2ms;
  other.root_bound = 3ms;
  EXPECT_EQ(distance(one, other), kUnknownClockError) << "their roots need not be UTC";
  one.root_is_utc = true;
  EXPECT_EQ(distance(one, other), kUnknownClockError) << "nor both";
  other.root_is_utc = true;
  EXPECT_EQ(distance(one, other), 5ms);
}

TEST(SyncChain, OneKernelIsOneClock) {
  SyncChain one = standing({{kFirst, kUnknownClockError}});
  SyncChain other;
  EXPECT_FALSE(share_clock(one, other)) << "neither is known";
  one.boot_id = other.boot_id = "8f4e";
  EXPECT_TRUE(share_clock(one, other));
  EXPECT_EQ(distance(one, other), 0us);
  other.boot_id = "8f4f";
  EXPECT_FALSE(share_clock(one, other));
}

TEST(SyncChain, NothingIsKnownOfAClockWithoutChain) {
  const SyncChain known = standing({{kSecond, 0us}, {kFirst, 100us}});
  EXPECT_EQ(distance(known, SyncChain()), kUnknownClockError);
  EXPECT_EQ(distance_from_anchor(SyncChain(), known), kUnknownClockError);
  EXPECT_EQ(distance_from_anchor(known, SyncChain()), kUnknownClockError);
}

TEST(SyncChain, ASampleIsAsFarAsItsStampAndTheReadersDistanceFromTheAnchor) {
  const SyncChain writer = standing({{kSecond, 1us}, {kFirst, 100us}});
  const SyncChain reader = standing({{kThird, 2us}, {kFirst, 30us}});
  EXPECT_EQ(distance_from_anchor(writer, reader), 30us);
}

TEST(SyncChain, AnAnchorThatTheReaderDoesNotKnowIsReachedByTheWritersClock) {
  const SyncChain writer = standing({{kSecond, 1us}, {kFirst, 100us}});
  const SyncChain reader = standing({{kThird, 2us}, {kSecond, 30us}});
  EXPECT_EQ(distance_from_anchor(writer, reader), 100us + 31us);
}

TEST(SyncChain, StampsAgainstUtcAreNotCountedTwice) {
  SyncChain writer = standing({{kFirst, 0us}});
  writer.root_is_utc = writer.bound_is_root = true;
  writer.root_bound = writer.bound = 4ms;
  SyncChain reader = standing({{kSecond, 0us}});
  reader.root_is_utc = true;
  reader.root_bound = 3ms;
  EXPECT_EQ(distance_from_anchor(writer, reader), 3ms);
  writer.bound_is_root = false;  // stamped against its own time, which may be 4 ms from UTC
  EXPECT_EQ(distance_from_anchor(writer, reader), 7ms);
}

TEST(SyncChain, AgesAllItsBounds) {
  SyncChain fresh = standing({{kSecond, 1us}, {kFirst, 100us}});
  fresh.root_bound = 1ms;
  fresh.ageing = 50'000;
  const SyncChain later = fresh.aged(2s);
  EXPECT_EQ(later.chain[0].bound, 101us);
  EXPECT_EQ(later.chain[1].bound, 200us);
  EXPECT_EQ(later.bound, 200us);
  EXPECT_EQ(later.root_bound, 1100us);
  EXPECT_EQ(fresh.aged(-1s), fresh) << "heard from the future: as good as new";
}

}  // namespace
}  // namespace dssm::clock
