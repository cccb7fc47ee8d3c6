// SPDX-License-Identifier: Apache-2.0
//
// Poses on the floor plan, and interpolation between them. All computations with poses are here, so
// that tests need no stream.
#pragma once

#include <cmath>
#include <cstdint>

namespace vehicle {

// Metres and radians in the recording's frame: seen from the start of the drive, x points ahead and
// y to the left; theta is counter-clockwise from x.
struct Pose2 {
  double x_m = 0, y_m = 0, theta_rad = 0;
};

// The pose at `weight` between `a` (0) and `b` (1). The angle takes the shorter way: halfway
// between 179 and -179 degrees is 180, not 0.
inline Pose2 interpolate(const Pose2& a, const Pose2& b, double weight) {
  constexpr double kFullTurn = 2 * M_PI;
  const double turn = std::remainder(b.theta_rad - a.theta_rad, kFullTurn);
  return {a.x_m + weight * (b.x_m - a.x_m), a.y_m + weight * (b.y_m - a.y_m),
          std::remainder(a.theta_rad + weight * turn, kFullTurn)};
}

// The weight of `t` between `before` (0) and `after` (1), all in the same unit; before <= t. 0 when
// `before` equals `after`.
inline double weight_of(std::int64_t t, std::int64_t before, std::int64_t after) {
  if (after <= before) return 0;
  return static_cast<double>(t - before) / static_cast<double>(after - before);
}

}  // namespace vehicle
