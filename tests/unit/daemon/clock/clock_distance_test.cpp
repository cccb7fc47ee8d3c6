// SPDX-License-Identifier: Apache-2.0
//
// Bounds of the distance of two clocks, by their reports, and what is remembered of measured ones.
#include "daemon/clock/clock_distance.hpp"

#include <gtest/gtest.h>

namespace dssm::clock {
namespace {

using namespace std::chrono_literals;
using wire::ClockLink, wire::ClockReport;

constexpr wire::HostId kFirst{1}, kSecond{2}, kThird{3}, kStranger{4};

// A clock whose samples are stamped against the last link.
ClockReport report(std::vector<ClockLink> chain) {
  ClockReport made;
  made.anchor = chain.back().host;
  made.clock.bound = chain.back().bound;
  made.chain = std::move(chain);
  return made;
}

TEST(ClockDistance, ClocksWithOneReferenceAreAsFarApartAsBothBoundsSay) {
  const ClockReport pc2 = report({{kSecond, 1us}, {kFirst, 100us}});
  const ClockReport pc3 = report({{kThird, 2us}, {kFirst, 30us}});
  EXPECT_EQ(distance(pc2, pc3), 130us);
  EXPECT_EQ(distance(pc3, pc2), 130us);
}

TEST(ClockDistance, AClockAndItsReferenceAreApartByBothDistancesFromTheReferencesTime) {
  const ClockReport pc1 = report({{kFirst, 5us}});
  const ClockReport pc2 = report({{kSecond, 1us}, {kFirst, 100us}});
  EXPECT_EQ(distance(pc1, pc2), 105us);
}

TEST(ClockDistance, TheShortestWayCounts) {
  // pc2 follows pc1, which is gone, and pc3 follows pc2: the way by pc2 does not grow.
  const ClockReport pc2 = report({{kSecond, 1us}, {kFirst, 900us}});
  const ClockReport pc3 = report({{kThird, 0us}, {kSecond, 40us}, {kFirst, 940us}});
  EXPECT_EQ(distance(pc2, pc3), 41us);
}

TEST(ClockDistance, WithoutACommonClockOnlyUtcHelps) {
  ClockReport one = report({{kFirst, 0us}});
  ClockReport other = report({{kStranger, 0us}});
  EXPECT_EQ(distance(one, other), kUnknownClockError);
  one.clock.root_bound = 2ms;
  other.clock.root_bound = 3ms;
  EXPECT_EQ(distance(one, other), kUnknownClockError) << "their roots need not be UTC";
  one.root_is_utc = true;
  EXPECT_EQ(distance(one, other), kUnknownClockError) << "nor both";
  other.root_is_utc = true;
  EXPECT_EQ(distance(one, other), 5ms);
}

TEST(ClockDistance, OneKernelIsOneClock) {
  ClockReport one = report({{kFirst, kUnknownClockError}});
  ClockReport other;
  EXPECT_FALSE(one.shares_clock_with(other)) << "neither is known";
  one.boot_id = other.boot_id = "8f4e";
  EXPECT_TRUE(one.shares_clock_with(other));
  EXPECT_EQ(distance(one, other), 0us);
  other.boot_id = "8f4f";
  EXPECT_FALSE(one.shares_clock_with(other));
}

TEST(ClockDistance, NothingIsKnownOfAClockWithoutChain) {
  const ClockReport known = report({{kSecond, 0us}, {kFirst, 100us}});
  EXPECT_EQ(distance(known, ClockReport()), kUnknownClockError);
  EXPECT_EQ(distance_from_anchor(ClockReport(), known), kUnknownClockError);
  EXPECT_EQ(distance_from_anchor(known, ClockReport()), kUnknownClockError);
}

TEST(ClockDistance, ASampleIsAsFarAsItsStampAndTheReadersDistanceFromTheAnchor) {
  const ClockReport writer = report({{kSecond, 1us}, {kFirst, 100us}});
  const ClockReport reader = report({{kThird, 2us}, {kFirst, 30us}});
  EXPECT_EQ(distance_from_anchor(writer, reader), 30us);
}

TEST(ClockDistance, AnAnchorThatTheReaderDoesNotKnowIsReachedByTheWritersClock) {
  const ClockReport writer = report({{kSecond, 1us}, {kFirst, 100us}});
  const ClockReport reader = report({{kThird, 2us}, {kSecond, 30us}});
  EXPECT_EQ(distance_from_anchor(writer, reader), 100us + 31us);
}

TEST(ClockDistance, StampsAgainstUtcAreNotCountedTwice) {
  ClockReport writer = report({{kFirst, 0us}});
  writer.root_is_utc = writer.bound_is_root = true;
  writer.clock.root_bound = writer.clock.bound = 4ms;
  ClockReport reader = report({{kSecond, 0us}});
  reader.root_is_utc = true;
  reader.clock.root_bound = 3ms;
  EXPECT_EQ(distance_from_anchor(writer, reader), 3ms);
  writer.bound_is_root = false;  // stamped against its own time, which may be 4 ms from UTC
  EXPECT_EQ(distance_from_anchor(writer, reader), 7ms);
}

TEST(ClockDistance, AgesAllItsBounds) {
  ClockReport fresh = report({{kSecond, 1us}, {kFirst, 100us}});
  fresh.clock.root_bound = 1ms;
  fresh.clock.ageing_ppb = 50'000;
  const ClockReport later = fresh.at(fresh.as_of + 2s);
  EXPECT_EQ(later.chain[0].bound, 101us);
  EXPECT_EQ(later.chain[1].bound, 200us);
  EXPECT_EQ(later.clock.bound, 200us);
  EXPECT_EQ(later.clock.root_bound, 1100us);
  EXPECT_EQ(fresh.at(fresh.as_of - 1s).clock, fresh.clock) << "an earlier time adds nothing";
}

// What was stated so many seconds before kNow.
class PastBoundsTest : public testing::Test {
 protected:
  void state(Duration before, Duration bound) { stated.add(kNow - before, bound); }
  // Once a second from `from` before kNow on, until less than `to` before it.
  void state_between(Duration from, Duration to, Duration bound) {
    for (Duration before = from; before > to; before -= 1s) state(before, bound);
  }
  PastBounds past(Duration latest = 40us) const { return stated.past(latest, kNow, 1500us); }

  static constexpr Time kNow{1'795'000'000s};
  StatedBounds stated;
};

TEST_F(PastBoundsTest, AreOfThisMomentWhenNothingWasStated) {
  EXPECT_EQ(past().greatest, 40us);
  EXPECT_EQ(past().from, kNow);
  EXPECT_EQ(past().recent, 40us);
  EXPECT_EQ(past().recent_from, kNow);
}

TEST_F(PastBoundsTest, LastSecondsDoNotCountByWhatWasStatedBefore) {
  state(10s, 900us);
  state(2s, 60us);
  state(1s, 50us);
  EXPECT_EQ(past().greatest, 900us);
  EXPECT_EQ(past().from, kNow - 10s);
  EXPECT_EQ(past().recent, 60us);
  EXPECT_EQ(past().recent_from, kNow - 2s);
  EXPECT_EQ(past(70us).recent, 70us);
}

TEST_F(PastBoundsTest, EndWhereAClockWasTooFarOff) {
  state(10s, 100us);
  state(2s, 1501us);
  state(1s, 50us);
  EXPECT_EQ(past().greatest, 50us);
  EXPECT_EQ(past().from, kNow - 1s);
  EXPECT_EQ(past().recent, 50us);
  EXPECT_EQ(past().recent_from, kNow - 1s);
  EXPECT_EQ(past(2ms).from, kNow - 10s) << "it still is";
}

TEST_F(PastBoundsTest, ReachAsFarBackAsTheClocksWereCompared) {
  state_between(10h, 0s, 50us);
  EXPECT_EQ(past().from, kNow - 10h);
  EXPECT_EQ(past().greatest, 50us);
}

TEST_F(PastBoundsTest, OfLongAgoIncludeTheGreatestOfTheirTime) {
  state_between(10h, 5h, 50us);
  state_between(5h, 5h - 2s, 149us);
  state_between(5h - 2s, 0s, 50us);
  EXPECT_EQ(past().from, kNow - 10h);
  EXPECT_EQ(past().greatest, 149us);
}

TEST_F(PastBoundsTest, DoNotReachToWhereTheClocksWereComparedLessWell) {
  state_between(10min, 5min, 800us);
  state_between(5min, 0s, 50us);
  EXPECT_EQ(past().greatest, 50us);
  EXPECT_GE(past().from, kNow - 5min);
  EXPECT_LE(past().from, kNow - 4min) << "in steps of some seconds";
  state_between(0s, -1s, 400us);
  EXPECT_EQ(past(400us).from, kNow - 10min);
}

TEST_F(PastBoundsTest, ReachToABusyMomentOfLongAgo) {
  state_between(10h, 5h, 50us);
  state(5h, 800us);
  state_between(5h - 1s, 0s, 50us);
  EXPECT_EQ(past().greatest, 50us);
  EXPECT_GE(past().from, kNow - 5h);
  EXPECT_LE(past().from, kNow - 4h);
}

TEST_F(PastBoundsTest, StayWhenTheClockIsSlewedBackwards) {
  state_between(100s, 0s, 50us);
  stated.add(kNow - 3s, 70us);
  EXPECT_EQ(past().from, kNow - 100s);
  EXPECT_EQ(past().greatest, 70us);
  stated.clear();
  EXPECT_EQ(past().from, kNow);
}

TEST_F(PastBoundsTest, DoNotReachOverATimeWithoutHeartbeats) {
  state_between(10min, 5min, 50us);
  state_between(5min - 20s, 0s, 50us);
  EXPECT_EQ(past().from, kNow - (5min - 20s));
}

TEST_F(PastBoundsTest, OfTheLastMinuteReachOverATimeWithoutHeartbeats) {
  state_between(5min, 40s, 50us);
  state_between(20s, 0s, 50us);
  EXPECT_GE(past().from, kNow - 61s);
  EXPECT_LE(past().from, kNow - 59s);
}

}  // namespace
}  // namespace dssm::clock
