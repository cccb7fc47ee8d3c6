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
  ClockLine line = ClockLine::now(0);
  line.tolerance = 1s;  // a slow machine, between two instructions
  EXPECT_TRUE(line.holds());
  line.wall += 1s;
  EXPECT_FALSE(line.holds());
  line.wall -= 2s;
  EXPECT_FALSE(line.holds());
}

TEST(ClockLine, DoesNotHoldWhereTheClocksCannotBeReadSoFast) {
  ClockLine line = ClockLine::now(0);
  EXPECT_GE(line.tolerance, 10us);
  line.tolerance = 1ns;
  EXPECT_FALSE(line.holds());
}

}  // namespace
}  // namespace dssm::clock
