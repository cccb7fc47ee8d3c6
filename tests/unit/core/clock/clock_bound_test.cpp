// SPDX-License-Identifier: Apache-2.0
#include "core/clock/clock_bound.hpp"

#include <gtest/gtest.h>

namespace dssm::clock {
namespace {

using namespace std::chrono_literals;

TEST(ClockBound, AddsOffsetDispersionAndHalfTheDelay) {
  EXPECT_EQ(bound_to_root(100ns, {20ns, 6ns}), 123ns);
  EXPECT_EQ(bound_to_root(-100ns, {20ns, 6ns}), 123ns);
  EXPECT_EQ(bound_to_root({}, {}), 0ns);
}

TEST(ClockBound, RoundsHalfTheDelayUp) { EXPECT_EQ(bound_to_root({}, {0ns, 7ns}), 4ns); }

TEST(ClockBound, LeavesOutWhatIsBeyondTheReference) {
  EXPECT_EQ(bound_to_reference(-1us, {300us, 500us}, {200us, 100us}), 1us + 100us + 200us);
}

TEST(ClockBound, SubtractsNothingForAReferenceThatIsFartherFromTheRoot) {
  EXPECT_EQ(bound_to_reference(1us, {200us, 500us}, {300us, 100us}), 1us + 200us);
  EXPECT_EQ(bound_to_reference(1us, {300us, 100us}, {200us, 500us}), 1us + 100us);
}

TEST(ClockBound, DoesNotGrowByAReferenceBelowZero) {
  EXPECT_EQ(bound_to_reference({}, {300us, 100us}, {-1s, -1s}), 350us);
}

TEST(ClockBound, IsNoneWhereItWouldOverflow) {
  EXPECT_EQ(bound_to_root(Duration::min(), {}), kUnknownClockError);
  EXPECT_EQ(bound_to_root(Duration::max() - 1ns, {2ns, 0ns}), kUnknownClockError);
  EXPECT_EQ(bound_to_root({}, {kUnknownClockError, 0ns}), kUnknownClockError);
  EXPECT_EQ(bound_to_reference({}, {0ns, kUnknownClockError}, {1s, 1s}), kUnknownClockError);
  EXPECT_EQ(sum(kUnknownClockError, 0ns), kUnknownClockError);
  EXPECT_EQ(sum(kUnknownClockError, kUnknownClockError), kUnknownClockError);
}

TEST(ClockBound, GrowsWithAgeRoundedUp) {
  EXPECT_EQ(growth(1s, 50'000), 50us);
  EXPECT_EQ(growth(3600s, 50'000), 180ms);
  EXPECT_EQ(growth(1ns, 50'000), 1ns);
  EXPECT_EQ(growth(1s + 1ns, 50'000), 50us + 1ns);
  EXPECT_EQ(growth(0s, 50'000), 0ns);
  EXPECT_EQ(growth(-1h, 50'000), 0ns);
  EXPECT_EQ(growth(1h, 0), 0ns);
}

TEST(ClockBound, GrowsBeyondAllBoundsRatherThanOverflow) {
  EXPECT_EQ(growth(Duration::max(), 2'000'000'000), kUnknownClockError);
  EXPECT_EQ(growth(Duration::max(), 1'000'000'000), kUnknownClockError);
  EXPECT_EQ(growth(2s, Duration::max().count()), kUnknownClockError);
  EXPECT_LT(growth(Duration::max(), 999'999'998), kUnknownClockError);
}

}  // namespace
}  // namespace dssm::clock
