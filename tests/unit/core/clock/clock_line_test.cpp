// SPDX-License-Identifier: Apache-2.0
#include "core/clock/clock_line.hpp"

#include <gtest/gtest.h>

namespace dssm::clock {
namespace {

using namespace std::chrono_literals;

constexpr RawTime kStart(1000s);
constexpr Time kWall(1'795'000'000s);

TEST(ClockLine, SaysWhatTheWallClockShows) {
  const ClockLine line{kStart, kWall, 20'000, 10us};
  EXPECT_EQ(line.at(kStart), kWall);
  EXPECT_EQ(line.at(kStart + 10s), kWall + 10s + 200us);
  EXPECT_EQ(line.at(kStart - 10s), kWall - 10s - 200us);
}

TEST(ClockLine, FollowsTheFastestSlew) {
  const ClockLine line{kStart, kWall, -ClockLine::kMaxRate, 10us};
  EXPECT_EQ(line.at(kStart + 1s), kWall + 800ms);
}

TEST(ClockLine, EndsAfterItsGreatestAge) {
  const ClockLine line{kStart, kWall, 0, 10us};
  EXPECT_TRUE(line.at(kStart + ClockLine::kMaxAge));
  EXPECT_FALSE(line.at(kStart + ClockLine::kMaxAge + 1ns));
  EXPECT_FALSE(line.at(kStart - ClockLine::kMaxAge - 1ns));
  EXPECT_FALSE(ClockLine().at(kStart)) << "there is none";
}

TEST(ClockLine, HoldsUntilTheClockHasLeftIt) {
  ClockLine line = ClockLine::through(ClockReading::now(), 0);
  line.tolerance = 1s;  // a slow machine, between two instructions
  EXPECT_TRUE(line.holds());
  line.wall += 2s;
  EXPECT_FALSE(line.holds());
  line.wall -= 4s;
  EXPECT_FALSE(line.holds());
}

TEST(ClockLine, ShowsOnlyWhatIsCertain) {
  const ClockLine line{kStart, kWall, 0, 10us};
  EXPECT_TRUE(line.shows({kStart + 1s, kWall + 1s + 6us, 4us}));
  EXPECT_FALSE(line.shows({kStart + 1s, kWall + 1s + 7us, 4us}));
  EXPECT_FALSE(line.shows({kStart + 1s, kWall + 1s - 7us, 4us}));
  EXPECT_FALSE(line.shows({kStart + 2h, kWall + 2h, 4us})) << "it is too old";
}

TEST(ClockLine, IsWithinOneThatAllowsMore) {
  const ClockLine line{kStart, kWall, 20'000, 30us};
  EXPECT_TRUE(line.is_within(line));
  EXPECT_TRUE((ClockLine{kStart + 1s, kWall + 1s + 40us, 20'000, 10us}.is_within(line)));
  EXPECT_TRUE((ClockLine{kStart + 1s, kWall + 1s, 20'000, 10us}.is_within(line)));
  EXPECT_FALSE((ClockLine{kStart + 1s, kWall + 1s + 41us, 20'000, 10us}.is_within(line)));
  EXPECT_FALSE((ClockLine{kStart + 1s, kWall + 1s - 1us, 20'000, 10us}.is_within(line)));
  EXPECT_FALSE((ClockLine{kStart + 1s, kWall + 1s + 20us, 20'001, 10us}.is_within(line)))
      << "it leaves it later";
  EXPECT_FALSE(line.is_within(ClockLine()));
  EXPECT_FALSE(ClockLine().is_within({kStart, kWall, 0, 30us})) << "there is none any more";
}

TEST(ClockLine, TakesItsRateFromReadingsThatAreFarEnoughApart) {
  ClockReading from{kStart, kWall, 5us};
  ClockLine line = ClockLine::through(from, 100);
  EXPECT_EQ(line.tolerance, ClockLine::kMaxOff + 7500ns);
  const ClockReading soon{kStart + 10ms, kWall + 11ms, 5us};  // certain to 10 us
  line = ClockLine::after(line, from, soon);
  EXPECT_EQ(line.raw, soon.raw);
  EXPECT_EQ(line.wall, soon.wall);
  EXPECT_EQ(line.rate, 100);
  EXPECT_EQ(from.raw, kStart) << "so that many that follow each other get a rate at last";
  const ClockReading later{kStart + 20ms, kWall + 22ms, 5us};
  line = ClockLine::after(line, from, later);
  EXPECT_EQ(line.wall, later.wall);
  EXPECT_EQ(line.rate, 100'000'000);
  EXPECT_EQ(from.raw, later.raw);
  line = ClockLine::after(line, from, {later.raw + 6ms, later.wall + 6ms, 1us});
  EXPECT_EQ(line.rate, 100'000'000);
  line = ClockLine::after(line, from, {kStart + 1s, kWall + 10s, 5us});
  EXPECT_EQ(line.rate, ClockLine::kMaxRate) << "faster than any clock";
}

// One that is replaced because reading the clocks takes longer or less. Its rate is better known.
TEST(ClockLine, KeepsItsRateWhileItIsRight) {
  const ClockReading first{kStart, kWall, 5us};
  ClockReading from = first;
  const ClockLine line = ClockLine::through(from, 20'000);
  const ClockReading slow{kStart + 1s, kWall + 1s + 24us, 30us};
  const ClockLine next = ClockLine::after(line, from, slow);
  EXPECT_EQ(next.raw, slow.raw);
  EXPECT_EQ(next.rate, 20'000);
  EXPECT_EQ(from.raw, first.raw);
  EXPECT_EQ(ClockLine::after(line, from, {kStart + 1s, kWall + 1s + 25us, 5us}).rate, 25'000);
}

// Bytes that came 5 ms ago.
class Arrival : public testing::Test {
 protected:
  Arrival() { measure(); }
  void measure() {
    line = ClockLine::through(ClockReading::now(), 0);
    line.tolerance = 1ms;  // a slow machine, between two instructions
    while (RawClock::now() < line.raw + 2ms) {
    }
    before = RawClock::now();
    stamp = WallClock::now();
    while (RawClock::now() < before + 5ms) {
    }
    now = RawClock::now();
  }

  ClockLine line;
  RawTime before, now;
  Time stamp;
};

TEST_F(Arrival, IsFoundByTheLineAndNeverTooEarly) {
  EXPECT_GE(line.arrival(stamp, now), before);
  EXPECT_LT(line.arrival(stamp, now), now);
  EXPECT_EQ(line.arrival(stamp + 1h, now), now);
}

// A clock that is slewed: after 40 s it shows 4 ms more, and is 1 ms off the line.
TEST_F(Arrival, FollowsTheRateOfTheLineAndAllowsForItsTolerance) {
  constexpr PartsPerBillion kRate = 100'000;
  line.raw -= 40s;
  line.wall -= 40s + 4ms;
  line.rate = kRate;
  line.tolerance = 3ms;
  const RawTime arrival = line.arrival(stamp - 1ms, now);
  EXPECT_GE(arrival, before);
  EXPECT_LT(arrival, before + 3ms);
  EXPECT_EQ(line.arrival(stamp - 10s, now), now) << "too long ago";
}

TEST_F(Arrival, IsNowIfItIsNotKnownOrTheClockWasSet) {
  EXPECT_EQ(line.arrival(std::nullopt, now), now);
  EXPECT_EQ(ClockLine().arrival(stamp, now), now);
  EXPECT_EQ(line.arrival(line.wall - 1ns, now), now) << "by the clock before it was set";
  line.wall -= 10s;
  EXPECT_EQ(line.arrival(stamp - 10s, now), now) << "the clock has left the line";
}

TEST(ClockLine, DoesNotHoldWhereTheClocksCannotBeReadSoFast) {
  ClockLine line = ClockLine::through(ClockReading::now(), 0);
  EXPECT_GE(line.tolerance, ClockLine::kMaxOff + 2us);
  line.tolerance = 1ns;
  EXPECT_FALSE(line.holds());
}

}  // namespace
}  // namespace dssm::clock
