// SPDX-License-Identifier: Apache-2.0
#include <gtest/gtest.h>

#include <array>
#include <cmath>
#include <cstring>
#include <dssm/interpolate.hpp>
#include <limits>

namespace dssm {
namespace {

using namespace std::chrono_literals;

struct Point {
  double x;
  float y;
};
DSSM_DESCRIBE(Point, x, y)

enum class Gear : std::int8_t { park, drive };

struct Everything {
  double real;
  float row[3];
  Point inner;
  Point points[2];
  std::int32_t count;
  bool on;
  Gear gear;
  char text[4];
  double not_described;
};
DSSM_DESCRIBE(Everything, real, row, inner, points, count, on, gear, text)

constexpr Everything kFrom{0,          {1, 2, 3}, {10, 20}, {{0, 2}, {4, 6}}, 100, false,
                           Gear::park, "aaa",     1};
constexpr Everything kTo{1,           {2, 4, 6}, {20, 0}, {{8, 10}, {12, 14}}, 200, true,
                         Gear::drive, "bbb",     2};

template <class T>
Sample<T> sample_at(std::int64_t time_ns, const T& value, Tid tid = 0, Duration clock_error = 0ns) {
  return {value, {tid, time_from_ns(time_ns), clock_error, sizeof(T)}};
}

TEST(Interpolate, IsLinearInFloatingPointFields) {
  const auto middle = interpolate(sample_at(1000, kFrom), sample_at(1400, kTo), time_from_ns(1100));
  ASSERT_TRUE(middle);
  const Everything& value = middle->value;
  EXPECT_EQ(value.real, 0.25);
  EXPECT_EQ(value.row[0], 1.25);
  EXPECT_EQ(value.row[1], 2.5);
  EXPECT_EQ(value.row[2], 3.75);
  EXPECT_EQ(value.inner.x, 12.5);
  EXPECT_EQ(value.inner.y, 15);
  EXPECT_EQ(value.points[0].x, 2);
  EXPECT_EQ(value.points[0].y, 4);
  EXPECT_EQ(value.points[1].x, 6);
  EXPECT_EQ(value.points[1].y, 8);
}

void expect_others(const Everything& value, const Everything& as) {
  EXPECT_EQ(value.count, as.count);
  EXPECT_EQ(value.on, as.on);
  EXPECT_EQ(value.gear, as.gear);
  EXPECT_STREQ(value.text, as.text);
  EXPECT_EQ(value.not_described, as.not_described);
}

TEST(Interpolate, TakesOtherFieldsFromTheNearerSample) {
  const auto before = sample_at(1000, kFrom, 5), after = sample_at(1400, kTo, 6);
  const auto early = interpolate(before, after, time_from_ns(1199));
  ASSERT_TRUE(early);
  expect_others(early->value, kFrom);
  EXPECT_EQ(early->tid(), 5);
  const auto middle = interpolate(before, after, time_from_ns(1200));
  ASSERT_TRUE(middle);
  expect_others(middle->value, kFrom);
  EXPECT_EQ(middle->value.real, 0.5);
  const auto late = interpolate(before, after, time_from_ns(1201));
  ASSERT_TRUE(late);
  expect_others(late->value, kTo);
  EXPECT_EQ(late->tid(), 6);
}

TEST(Interpolate, GivesTheSamplesThemselvesAtTheirTimes) {
  const auto before = sample_at(1000, kFrom), after = sample_at(1400, kTo);
  EXPECT_EQ(interpolate(before, after, before.time())->value.real, kFrom.real);
  expect_others(interpolate(before, after, before.time())->value, kFrom);
  EXPECT_EQ(interpolate(before, after, after.time())->value.real, kTo.real);
  expect_others(interpolate(before, after, after.time())->value, kTo);
}

TEST(Interpolate, RefusesTimesOutside) {
  const auto before = sample_at(1000, 1.0), after = sample_at(1400, 2.0);
  EXPECT_EQ(interpolate(before, after, time_from_ns(999)).status(), ReadStatus::too_old);
  EXPECT_EQ(interpolate(before, after, time_from_ns(1401)).status(), ReadStatus::not_yet);
  EXPECT_FALSE(interpolate(after, before, time_from_ns(1200))) << "in the wrong order";
}

TEST(Interpolate, TakesTheLaterOfTwoSamplesOfOneTime) {
  const auto both =
      interpolate(sample_at(1000, 1.0, 0), sample_at(1000, 2.0, 1), time_from_ns(1000));
  ASSERT_TRUE(both);
  EXPECT_EQ(both->value, 2) << "as read_at()";
  EXPECT_EQ(both->tid(), 1);
  EXPECT_FALSE(interpolate(sample_at(1000, 1.0), sample_at(1000, 2.0), time_from_ns(1001)));
}

TEST(Interpolate, StatesTheTimeAndTheGreaterClockError) {
  const auto middle =
      interpolate(sample_at(1000, 1.0, 0, 30ns), sample_at(2000, 2.0, 1, 20ns), time_from_ns(1900));
  ASSERT_TRUE(middle);
  EXPECT_EQ(middle->time(), time_from_ns(1900));
  EXPECT_EQ(middle->clock_error(), 30ns);
  EXPECT_EQ(interpolate(sample_at(0, 1.0, 0, 30ns), sample_at(9, 2.0, 1, kUnknownClockError),
                        time_from_ns(1))
                ->clock_error(),
            kUnknownClockError);
}

// Sensors write them for "no value".
TEST(Interpolate, TakesWhatIsNotFiniteFromTheNearerSample) {
  constexpr double kNan = std::numeric_limits<double>::quiet_NaN();
  constexpr double kInfinite = std::numeric_limits<double>::infinity();
  using Row = std::array<double, 4>;
  const auto before = sample_at(0, Row{kNan, 1, kInfinite, kInfinite});
  const auto after = sample_at(10, Row{1, kNan, kInfinite, -kInfinite});
  const auto early = interpolate(before, after, time_from_ns(1));
  ASSERT_TRUE(early);
  EXPECT_TRUE(std::isnan(early->value[0]));
  EXPECT_EQ(early->value[1], 1);
  EXPECT_EQ(early->value[2], kInfinite);
  EXPECT_EQ(early->value[3], kInfinite);
  const auto late = interpolate(before, after, time_from_ns(9));
  ASSERT_TRUE(late);
  EXPECT_EQ(late->value[0], 1);
  EXPECT_TRUE(std::isnan(late->value[1]));
  EXPECT_EQ(late->value[3], -kInfinite);
}

TEST(Interpolate, WorksOverAllTimes) {
  const auto middle = interpolate(sample_at(INT64_MIN, 0.0), sample_at(INT64_MAX, 4.0),
                                  time_from_ns(INT64_MAX / 2));
  ASSERT_TRUE(middle);
  EXPECT_EQ(middle->value, 3);
}

struct Angle {
  double degrees;
};
DSSM_DESCRIBE(Angle, degrees)

// The shorter way round.
Angle dssm_interpolate(const Angle& before, const Angle& after, double fraction) {
  const double turn = std::remainder(after.degrees - before.degrees, 360.0);
  return {std::fmod(before.degrees + fraction * turn + 360, 360)};
}

TEST(Interpolate, UsesTheFunctionOfTheType) {
  const auto north = interpolate(sample_at(0, Angle{358}), sample_at(4, Angle{2}), time_from_ns(3));
  ASSERT_TRUE(north);
  EXPECT_EQ(north->value.degrees, 1);
  EXPECT_EQ(north->time(), time_from_ns(3));
}

}  // namespace
}  // namespace dssm
