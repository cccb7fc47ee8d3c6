// SPDX-License-Identifier: Apache-2.0
#include "core/base/time.hpp"

#include <gtest/gtest.h>

namespace dssm {
namespace {

using namespace std::chrono_literals;

TEST(Time, IsOfTheStandardClocks) {
  const auto system_now = std::chrono::system_clock::now();
  const Time wall = system_now;
  EXPECT_EQ(std::chrono::system_clock::to_time_t(wall), to_ns(wall) / 1'000'000'000);
  EXPECT_LE(wall, WallClock::now());
  const MonoTime before = MonoClock::now();
  const MonoTime between = std::chrono::steady_clock::now();
  EXPECT_LE(before, between);
  EXPECT_LE(between, MonoClock::now());
}

TEST(Time, OfTheTwoClocksDoesNotMix) {
  EXPECT_FALSE((std::is_convertible_v<Time, MonoTime>));
  EXPECT_FALSE((std::is_convertible_v<MonoTime, Time>));
  EXPECT_FALSE((std::is_convertible_v<Duration, Time>));
  EXPECT_FALSE((std::is_convertible_v<Duration, MonoTime>));
}

TEST(IsStale, CountsFromTheSampleToTheRequestedTime) {
  const Time t = time_from_ns(1'000'000);
  EXPECT_FALSE(is_stale(t, t, 0ns));
  EXPECT_TRUE(is_stale(t, t - 1ns, 0ns));
  EXPECT_FALSE(is_stale(t, t - 10ns, 10ns));
  EXPECT_TRUE(is_stale(t, t - 11ns, 10ns));
  EXPECT_TRUE(is_stale(t, t - 1ns, -5ns)) << "a negative age is 0";
}

TEST(IsStale, HasNoLimitWithAnyAge) {
  EXPECT_FALSE(is_stale(Time::max(), Time::min(), kAnyAge));
  EXPECT_TRUE(is_stale(Time::max(), Time::min(), kAnyAge - 1ns));
}

}  // namespace
}  // namespace dssm
