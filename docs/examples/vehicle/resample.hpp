// SPDX-License-Identifier: Apache-2.0
//
// Converts a recording's odometry to that of an encoder with a constant rate, and selects the
// readings for the scans of a given span.
#pragma once

#include <cstddef>
#include <vector>

#include "carmen_log.hpp"

namespace vehicle {

// Interpolates `readings` (in order of time) at all whole multiples of `cycle_s` > 0 seconds, so
// that encoders for different spans give the same samples.
std::vector<OdometryReading> resample(const std::vector<OdometryReading>& readings, double cycle_s);

// Indices of readings: begin to end - 1.
struct Span {
  std::size_t begin = 0, end = 0;
};

// The readings from `from_s` to `to_s`, and one more on each side if there is one, so that a scan
// at the edge has neighbours on both sides.
Span span_around(const std::vector<OdometryReading>& readings, double from_s, double to_s);

}  // namespace vehicle
