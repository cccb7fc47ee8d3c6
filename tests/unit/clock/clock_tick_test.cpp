// SPDX-License-Identifier: Apache-2.0
#include "core/clock/clock_tick.hpp"

#include <gtest/gtest.h>

#include "core/clock/clock_estimator.hpp"

namespace dssm::clock {
namespace {

using namespace std::chrono_literals;

// Through hundreds of ticks, also while chronyd slews the clock.
TEST(Tick, ShowsOneDifferenceUntilTheClockIsSet) {
  std::optional<Tick> first;
  int seen = 0;
  for (const MonoTime end = deadline_in(1s); MonoClock::now() < end;) {
    const std::optional<Tick> tick = Tick::last();
    if (!tick) continue;
    if (!first) first = tick;
    ASSERT_EQ(tick->difference, first->difference) << "after " << seen << " looks";
    ++seen;
  }
  EXPECT_GT(seen, 100);
}

TEST(Tick, IsNotFarFromNow) {
  constexpr Duration kTickOfAnyKernel = 11ms;  // CONFIG_HZ=100, and some time for ourselves
  for (int attempt = 0; attempt < 1000; ++attempt) {
    const MonoTime before = MonoClock::now();
    const std::optional<Tick> tick = Tick::last();
    const Instant now = Instant::now();
    if (!tick || now.mono - before > 1ms) continue;
    EXPECT_LE(tick->mono, now.mono);
    EXPECT_GE(tick->mono, before - kTickOfAnyKernel);
    const Duration difference = now.wall - Time(now.mono.time_since_epoch());
    EXPECT_LE(std::chrono::abs(difference - tick->difference), now.width + 1us);
    return;
  }
  FAIL() << "interrupted each time";
}

}  // namespace
}  // namespace dssm::clock
