// SPDX-License-Identifier: Apache-2.0
//
// Compares interpolation with values computed by hand.
#include "docs/examples/vehicle/pose.hpp"

#include <gtest/gtest.h>

#include <cmath>

#include "docs/examples/vehicle/resample.hpp"

namespace vehicle {
namespace {

constexpr double kDegree = M_PI / 180;

TEST(Interpolate, InterpolatesLinearly) {
  const Pose2 a{1, -2, 0.1}, b{3, 2, 0.5};
  const Pose2 quarter = interpolate(a, b, 0.25);
  EXPECT_DOUBLE_EQ(quarter.x_m, 1.5);
  EXPECT_DOUBLE_EQ(quarter.y_m, -1);
  EXPECT_DOUBLE_EQ(quarter.theta_rad, 0.2);
}

TEST(Interpolate, ReturnsTheEndsAtTheEnds) {
  const Pose2 a{1, -2, 0.1}, b{3, 2, 0.5};
  EXPECT_EQ(interpolate(a, b, 0).x_m, 1);
  EXPECT_EQ(interpolate(a, b, 0).theta_rad, 0.1);
  EXPECT_EQ(interpolate(a, b, 1).x_m, 3);
  EXPECT_DOUBLE_EQ(interpolate(a, b, 1).theta_rad, 0.5);
}

TEST(Interpolate, TurnsTheShorterWay) {
  // From 170 to -170 degrees: 20 degrees over 180, not 340 back through 0.
  EXPECT_NEAR(interpolate({0, 0, 170 * kDegree}, {0, 0, -170 * kDegree}, 0.25).theta_rad,
              175 * kDegree, 1e-12);
  EXPECT_NEAR(interpolate({0, 0, 170 * kDegree}, {0, 0, -170 * kDegree}, 0.75).theta_rad,
              -175 * kDegree, 1e-12);
  EXPECT_NEAR(interpolate({0, 0, -170 * kDegree}, {0, 0, 170 * kDegree}, 0.25).theta_rad,
              -175 * kDegree, 1e-12);
  EXPECT_NEAR(interpolate({0, 0, 0}, {0, 0, 90 * kDegree}, 0.5).theta_rad, 45 * kDegree, 1e-12);
}

TEST(Interpolate, AcceptsAnglesAboveAFullTurn) {
  // 10 and 730 degrees are the same as 10 and 10.
  EXPECT_NEAR(interpolate({0, 0, 10 * kDegree}, {0, 0, 730 * kDegree}, 0.5).theta_rad, 10 * kDegree,
              1e-12);
}

TEST(WeightOf, IsExactToTheNanosecond) {
  constexpr std::int64_t kToday = 1'700'000'000'000'000'000;  // as a double: to 256 ns only
  EXPECT_EQ(weight_of(kToday, kToday, kToday + 4), 0);
  EXPECT_EQ(weight_of(kToday + 1, kToday, kToday + 4), 0.25);
  EXPECT_EQ(weight_of(kToday + 3, kToday, kToday + 4), 0.75);
}

TEST(WeightOf, IsZeroForEqualTimes) { EXPECT_EQ(weight_of(5, 5, 5), 0); }

TEST(Resample, InterpolatesAtWholeMultiplesOfTheCycle) {
  const std::vector<OdometryReading> recorded{
      {0.1, {0, 0, 0}}, {0.5, {4, 8, 0.4}}, {0.75, {4, 8, 0.4}}};
  const std::vector<OdometryReading> steady = resample(recorded, 0.25);
  ASSERT_EQ(steady.size(), 3u);  // 0.25, 0.5, 0.75
  EXPECT_DOUBLE_EQ(steady[0].time_s, 0.25);
  EXPECT_NEAR(steady[0].pose.x_m, 1.5, 1e-12);  // 0.15 of 0.4 seconds
  EXPECT_NEAR(steady[0].pose.y_m, 3, 1e-12);
  EXPECT_NEAR(steady[0].pose.theta_rad, 0.15, 1e-12);
  EXPECT_DOUBLE_EQ(steady[1].pose.x_m, 4);
  EXPECT_DOUBLE_EQ(steady[2].time_s, 0.75);
}

TEST(Resample, AcceptsEmptyAndSingleRecordings) {
  EXPECT_TRUE(resample({}, 0.1).empty());
  EXPECT_EQ(resample({{0.5, {1, 2, 3}}}, 0.25).size(), 1u);
  EXPECT_TRUE(resample({{0.3, {1, 2, 3}}}, 0.25).empty());  // no multiple of 0.25 in it
}

TEST(SpanAround, IncludesOneMoreReadingOnEachSide) {
  const std::vector<OdometryReading> readings{{1, {}}, {2, {}}, {3, {}}, {4, {}}, {5, {}}};
  const Span inside = span_around(readings, 2.5, 3.5);  // 3, and 2 and 4 around it
  EXPECT_EQ(inside.begin, 1u);
  EXPECT_EQ(inside.end, 4u);
  const Span edges = span_around(readings, 2, 4);  // a scan at 4 needs a reading after it
  EXPECT_EQ(edges.begin, 1u);
  EXPECT_EQ(edges.end, 5u);
  const Span all = span_around(readings, -10, 10);
  EXPECT_EQ(all.begin, 0u);
  EXPECT_EQ(all.end, 5u);
  const Span none = span_around({}, 0, 1);
  EXPECT_EQ(none.begin, none.end);
}

}  // namespace
}  // namespace vehicle
