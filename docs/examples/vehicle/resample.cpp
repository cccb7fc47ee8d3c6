// SPDX-License-Identifier: Apache-2.0
#include "resample.hpp"

#include <algorithm>
#include <cmath>

namespace vehicle {

std::vector<OdometryReading> resample(const std::vector<OdometryReading>& readings,
                                      double cycle_s) {
  std::vector<OdometryReading> result;
  std::size_t i = 0;  // readings[i] is the newest one at or before time_s
  for (double n = readings.empty() ? 0 : std::ceil(readings.front().time_s / cycle_s);
       !readings.empty() && n * cycle_s <= readings.back().time_s; n += 1) {
    const double time_s = n * cycle_s;
    while (i + 1 < readings.size() && readings[i + 1].time_s <= time_s) ++i;
    const OdometryReading& before = readings[i];
    const OdometryReading& after = readings[std::min(i + 1, readings.size() - 1)];
    const double between_s = after.time_s - before.time_s;
    const double weight = between_s > 0 ? (time_s - before.time_s) / between_s : 0;
    result.push_back({time_s, interpolate(before.pose, after.pose, weight)});
  }
  return result;
}

Span span_around(const std::vector<OdometryReading>& readings, double from_s, double to_s) {
  const auto first = std::partition_point(
      readings.begin(), readings.end(),
      [&](const OdometryReading& reading) { return reading.time_s <= from_s; });
  const auto last =
      std::partition_point(readings.begin(), readings.end(),
                           [&](const OdometryReading& reading) { return reading.time_s <= to_s; });
  return {static_cast<std::size_t>(std::max(first - readings.begin() - 1, std::ptrdiff_t{0})),
          static_cast<std::size_t>(
              std::min(last - readings.begin() + 1, static_cast<std::ptrdiff_t>(readings.size())))};
}

}  // namespace vehicle
