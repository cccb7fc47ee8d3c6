// SPDX-License-Identifier: Apache-2.0
#include "client/view/curves.hpp"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <limits>

namespace dssm::view {
namespace {

using namespace std::chrono_literals;

constexpr double kNotANumber = std::numeric_limits<double>::quiet_NaN();

TEST(CurveBuilder, KeepsTheLeastAndTheGreatestOfEachSlice) {
  CurveBuilder builder(10s, 10);
  for (int i = 0; i < 10'000; ++i) {
    const double value = i == 4321 ? 7 : i == 4444 ? -7 : std::sin(i * 0.01);
    builder.add(Duration(1ms) * i, i, value, false);
  }
  const Curve curve = builder.take();
  EXPECT_EQ(curve.values.size(), 20U);
  EXPECT_EQ(curve.times_s.size(), 20U);
  EXPECT_TRUE(std::ranges::is_sorted(curve.times_s));
  const auto peak = std::ranges::find(curve.tids, 4321);
  ASSERT_NE(peak, curve.tids.end());
  EXPECT_EQ(*(peak + 1), 4444);
  EXPECT_EQ(curve.values[static_cast<std::size_t>(peak - curve.tids.begin())], 7);
}

TEST(CurveBuilder, KeepsAllOfFewSamples) {
  CurveBuilder builder(1s, 1000);
  builder.add(-1ms, 6, 1, false);
  builder.add(0ms, 7, 2, false);
  builder.add(500ms, 8, 3, false);
  builder.add(1s, 9, 4, false);
  const Curve curve = builder.take();
  EXPECT_EQ(curve.values, (std::vector<double>{1, 2, 3, 4}));
  EXPECT_EQ(curve.tids, (std::vector<double>{6, 7, 8, 9}));
  EXPECT_EQ(curve.times_s, (std::vector<double>{-0.001, 0, 0.5, 1}));
}

TEST(CurveBuilder, BreaksWhereSamplesAreMissing) {
  CurveBuilder builder(10s, 1000);
  builder.add(1s, 1, 1, false);
  builder.add(2s, 2, 2, false);
  builder.add(5s, 5, 5, true);
  builder.add(6s, 6, kNotANumber, false);
  builder.add(7s, 7, 7, false);
  const Curve curve = builder.take();
  ASSERT_EQ(curve.values.size(), 6U);
  EXPECT_TRUE(std::isnan(curve.values[2]));
  EXPECT_EQ(curve.times_s[2], 5);
  EXPECT_EQ(curve.values[3], 5);
  EXPECT_TRUE(std::isnan(curve.values[4]));
  EXPECT_EQ(curve.values[5], 7);
}

TEST(CurveBuilder, BreaksInTheMidstOfASlice) {
  CurveBuilder builder(10s, 1);
  builder.add(1s, 1, 1, false);
  builder.add(2s, 2, kNotANumber, false);
  builder.add(3s, 3, 3, false);
  builder.add(4s, 4, 4, false);
  const Curve curve = builder.take();
  ASSERT_EQ(curve.tids, (std::vector<double>{1, 2, 3, 4}));
  EXPECT_TRUE(std::isnan(curve.values[1]));
}

// A recording that is played again: plots need rising times.
TEST(CurveBuilder, LeavesOutTimesThatRunBackwards) {
  CurveBuilder builder(10s, 1000);
  builder.add(3s, 1, 1, false);
  builder.add(2s, 2, 2, false);
  builder.add(3s, 3, 3, false);
  builder.add(4s, 4, 4, false);
  EXPECT_EQ(builder.take().tids, (std::vector<double>{1, 3, 4}));
}

}  // namespace
}  // namespace dssm::view
