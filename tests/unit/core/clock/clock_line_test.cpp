// SPDX-License-Identifier: Apache-2.0
#include "core/clock/clock_line.hpp"

#include <gtest/gtest.h>

namespace dssm::clock {
namespace {

using namespace std::chrono_literals;

constexpr RawTime kStart(1000s);
constexpr Time kWall(1'795'000'000s);

TEST(ClockLine, SaysWhatTheWallClockShows) {
  const ClockLine line{kStart, kWall, 20'000};
  EXPECT_EQ(line.at(kStart), kWall);
  EXPECT_EQ(line.at(kStart + 10s), kWall + 10s + 200us);
  EXPECT_EQ(line.at(kStart - 10s), kWall - 10s - 200us);
}

TEST(ClockLine, FollowsTheFastestSlew) {
  const ClockLine line{kStart, kWall, -ClockLine::kMaxRate};
  EXPECT_EQ(line.at(kStart + 1s), kWall + 800ms);
}

TEST(ClockLine, EndsAfterItsGreatestAge) {
  const ClockLine line{kStart, kWall, 0};
  EXPECT_TRUE(line.at(kStart + ClockLine::kMaxAge));
  EXPECT_FALSE(line.at(kStart + ClockLine::kMaxAge + 1ns));
  EXPECT_FALSE(line.at(kStart - ClockLine::kMaxAge - 1ns));
  EXPECT_FALSE(ClockLine().at(kStart)) << "there is none";
}

}  // namespace
}  // namespace dssm::clock
