// SPDX-License-Identifier: Apache-2.0
#include "odometry_at.hpp"

#include <algorithm>
#include <utility>

#include "stop.hpp"

namespace vehicle {
namespace {

// Not by dssm::interpolate(), because the angle takes the shorter way.
Pose2 between(dssm::Time t, const dssm::Sample<Odometry>& before,
              const dssm::Sample<Odometry>& after) {
  const auto pose = [](const Odometry& at) { return Pose2{at.x_m, at.y_m, at.theta_rad}; };
  return interpolate(
      pose(before.value), pose(after.value),
      weight_of(dssm::to_ns(t), dssm::to_ns(before.time()), dssm::to_ns(after.time())));
}

}  // namespace

OdometryAt::OdometryAt(dssm::Reader<Odometry> reader, dssm::Duration deadline)
    : reader_(std::move(reader)), deadline_(deadline), newest_at_start_(reader_.newest_tid()) {}

std::optional<Pose2> OdometryAt::at(dssm::Time t) {
  const dssm::MonoTime deadline = dssm::deadline_in(deadline_);
  while (!stop_requested()) {
    const dssm::Tid newest =
        reader_.newest_tid();  // before the search: wait_for_tid() misses nothing
    const auto readings = reader_.read_neighbours(t);
    if (readings) return between(t, readings->before, readings->after);
    if (readings.status() == dssm::ReadStatus::restarted) {
      newest_at_start_ = dssm::kNoTid;
      continue;
    }
    // Final, unless the ring holds only samples of an earlier drive with later stamps.
    if (readings.status() == dssm::ReadStatus::too_old && newest != newest_at_start_) {
      return std::nullopt;
    }
    const dssm::MonoTime now = dssm::MonoClock::now();
    if (now >= deadline) return std::nullopt;
    (void)reader_.wait_for_tid(newest + 1, std::min(deadline, now + kSlice));
  }
  return std::nullopt;
}

}  // namespace vehicle
