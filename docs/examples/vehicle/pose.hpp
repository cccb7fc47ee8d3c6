// SPDX-License-Identifier: Apache-2.0
//
// Positions on the floor plan and how to get from one to the other in time. Everything that the
// vehicle's programs compute about poses is here, so that it can be tested without a stream.
#pragma once

#include <cmath>
#include <cstdint>

namespace vehicle {

// Metres and radians in the recording's frame: x ahead and y to the left of where the drive began,
// theta counter-clockwise from x.
struct Pose2 {
  double x_m = 0, y_m = 0, theta_rad = 0;
};

// The pose at `weight` of the way from `a` (0) to `b` (1); the angle goes the shorter way round,
// so that half-way between 179 and -179 degrees lies 180 and not 0.
inline Pose2 interpolate(const Pose2& a, const Pose2& b, double weight) {
  constexpr double kFullTurn = 2 * M_PI;
  const double turn = std::remainder(b.theta_rad - a.theta_rad, kFullTurn);
  return {a.x_m + weight * (b.x_m - a.x_m), a.y_m + weight * (b.y_m - a.y_m),
          std::remainder(a.theta_rad + weight * turn, kFullTurn)};
}

// How far `t` lies on the way from `before` to `after`, between 0 and 1: all in one unit of time,
// before <= t. 0 when the two coincide.
inline double weight_of(std::int64_t t, std::int64_t before, std::int64_t after) {
  if (after <= before) return 0;
  return static_cast<double>(t - before) / static_cast<double>(after - before);
}

}  // namespace vehicle
