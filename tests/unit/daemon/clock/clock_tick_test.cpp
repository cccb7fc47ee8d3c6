// SPDX-License-Identifier: Apache-2.0
#include "daemon/clock/clock_tick.hpp"

#include <gtest/gtest.h>

#include "daemon/clock/clock_estimator.hpp"

namespace dssm::clock {
namespace {

using namespace std::chrono_literals;

// No tick came while we looked: twice in a row it would have been another one.
Tick last_whole() {
  Tick tick = Tick::last();
  for (int attempts = 0; attempts < 1000; ++attempts) {
    const Tick next = Tick::last();
    if (next.difference == tick.difference) return tick;
    tick = next;
  }
  ADD_FAILURE() << "no two looks in a row saw the same tick";
  return tick;
}

// Through dozens of ticks, also while chronyd slews the clock.
TEST(Tick, ShowsOneDifferenceUntilTheClockIsSet) {
  const Tick first = last_whole();
  int seen = 0;
  for (const MonoTime end = deadline_in(300ms); MonoClock::now() < end; ++seen) {
    ASSERT_EQ(last_whole().difference, first.difference) << "after " << seen << " looks";
  }
  EXPECT_GT(seen, 100);
}

TEST(Tick, IsNotFarFromNow) {
  constexpr Duration kTickOfAnyKernel = 11ms;  // CONFIG_HZ=100, and some time for ourselves
  for (int attempt = 0; attempt < 1000; ++attempt) {
    const MonoTime before = MonoClock::now();
    const Tick tick = last_whole();
    const Instant now = Instant::now();
    if (now.mono - before > 1ms) continue;
    EXPECT_LE(tick.mono, now.mono);
    EXPECT_GE(tick.mono, before - kTickOfAnyKernel);
    const Duration difference = now.wall - Time(now.mono.time_since_epoch());
    EXPECT_LE(std::chrono::abs(difference - tick.difference), now.width + 1us);
    return;
  }
  FAIL() << "interrupted each time";
}

}  // namespace
}  // namespace dssm::clock
