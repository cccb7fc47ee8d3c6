// SPDX-License-Identifier: Apache-2.0
//
// From a recording's odometry to the one an encoder with a steady rate would have given, and the
// part of it that somebody needs who looks at scans of a given span.
#pragma once

#include <cstddef>
#include <vector>

#include "carmen_log.hpp"

namespace vehicle {

// `readings` (in order of time) read every `cycle_s` > 0 seconds, at whole multiples of it so that
// encoders started for different spans give the same samples.
std::vector<OdometryReading> resample(const std::vector<OdometryReading>& readings, double cycle_s);

// Indices of readings: begin to end - 1.
struct Span {
  std::size_t begin = 0, end = 0;
};

// The readings from `from_s` to `to_s`, and one more at each side where there is one: a scan at the
// edge has neighbours on both sides then.
Span span_around(const std::vector<OdometryReading>& readings, double from_s, double to_s);

}  // namespace vehicle
