// SPDX-License-Identifier: Apache-2.0
#include <gtest/gtest.h>

#include "core/clock/clock_page.hpp"

namespace dssm::clock {
namespace {

using namespace std::chrono_literals;

class ClockErrorCacheTest : public testing::Test {
 protected:
  ClockErrorCacheTest() {
    stated.wall = Time(50s);
    stated.clock.bound = 100us;
    stated.clock.ageing_ppb = 56'250;
    stated.earlier_from = Time(40s);
    stated.earlier_bound = 400us;
    page.state.store(stated);
  }

  std::optional<Duration> at(Time t) {
    Duration error{};
    return cache.find(&page, t, error) ? std::optional(error) : std::nullopt;
  }
  // As clock_error_at() says, a little more at most.
  void expect_same(Time t) {
    const std::optional<Duration> found = at(t);
    const Duration exact = clock_error_at(page, t).value();
    ASSERT_TRUE(found) << to_ns(t);
    EXPECT_GE(*found, exact) << to_ns(t);
    EXPECT_LE(*found - exact, 2ns) << to_ns(t);
  }

  ClockPage page{};
  ClockPageState stated;
  ClockErrorCache cache;
};

TEST_F(ClockErrorCacheTest, ReturnsWhatThePageStates) {
  for (const Duration age : {0ns, 1ns, 999ns, 1'000'000ns, 1'000'000'001ns, Duration(kMaxUse)}) {
    expect_same(stated.wall + age);
  }
}

TEST_F(ClockErrorCacheTest, SeesWhatIsStoredLater) {
  expect_same(Time(51s));
  stated.wall = Time(51s);
  stated.clock.bound = 7us;
  page.state.store(stated);
  expect_same(Time(51s));
  EXPECT_EQ(at(Time(51s)), 7us);
  stated.clock.bound = kUnknownClockError;
  page.state.store(stated);
  EXPECT_EQ(at(Time(52s)), kUnknownClockError);
}

TEST_F(ClockErrorCacheTest, DistinguishesPages) {
  EXPECT_EQ(at(Time(50s)), 100us);
  ClockPage other{};
  stated.clock.bound = 3us;
  other.state.store(stated);
  Duration error{};
  EXPECT_TRUE(cache.find(&other, Time(50s), error));
  EXPECT_EQ(error, 3us);
}

TEST_F(ClockErrorCacheTest, LeavesOtherTimesToTheWholePage) {
  EXPECT_EQ(at(Time(50s) - 1ns), std::nullopt);
  EXPECT_EQ(at(Time(50s) + kMaxUse + 1ns), std::nullopt);
  EXPECT_EQ(at(Time::min()), std::nullopt);
  EXPECT_EQ(at(Time::max()), std::nullopt);
  Duration error{};
  EXPECT_FALSE(cache.find(nullptr, Time(50s), error));
}

TEST_F(ClockErrorCacheTest, DoesNotOverflow) {
  stated.clock.bound = kUnknownClockError - 1ns;
  stated.clock.ageing_ppb = 1'000'000;
  page.state.store(stated);
  EXPECT_EQ(at(stated.wall + kMaxUse), kUnknownClockError);
  stated.clock.bound = Duration::zero();
  page.state.store(stated);
  expect_same(stated.wall + kMaxUse);
}

}  // namespace
}  // namespace dssm::clock
