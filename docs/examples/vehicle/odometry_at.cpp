// SPDX-License-Identifier: Apache-2.0
#include "odometry_at.hpp"

#include <algorithm>
#include <utility>

#include "stop.hpp"

namespace vehicle {

OdometryAt::OdometryAt(dssm::Reader<Odometry> reader, dssm::Duration deadline)
    : reader_(std::move(reader)), deadline_(deadline), newest_at_start_(reader_.newest_tid()) {}

std::optional<Pose2> OdometryAt::between(dssm::Time t, const dssm::Neighbours& readings) {
  Odometry before, after;
  dssm::SampleInfo info;
  if (reader_.read_tid(readings.before.tid, before, info) != dssm::ReadStatus::ok ||
      reader_.read_tid(readings.after.tid, after, info) != dssm::ReadStatus::ok) {
    return std::nullopt;  // overwritten since the search, or the stream restarted
  }
  return interpolate({before.x_m, before.y_m, before.theta_rad},
                     {after.x_m, after.y_m, after.theta_rad},
                     weight_of(dssm::to_ns(t), dssm::to_ns(readings.before.time),
                               dssm::to_ns(readings.after.time)));
}

bool OdometryAt::follow_restart() {
  Odometry newest;
  dssm::SampleInfo info;
  (void)reader_.read_newest(newest, info);
  if (reader_.restarts() == restarts_) return false;
  restarts_ = reader_.restarts();
  newest_at_start_ = dssm::kNoTid;
  return true;
}

std::optional<Pose2> OdometryAt::at(dssm::Time t) {
  const dssm::MonoTime deadline = dssm::deadline_in(deadline_);
  while (!stop_requested()) {
    const dssm::Tid newest =
        reader_.newest_tid();  // before the search: wait_for_tid() misses nothing
    dssm::Neighbours readings;
    const dssm::ReadStatus status = reader_.find_neighbours(t, readings);
    if (status == dssm::ReadStatus::ok) {
      if (const std::optional<Pose2> pose = between(t, readings)) return pose;
    }
    if (follow_restart() || status == dssm::ReadStatus::ok) continue;
    // Final, unless the ring holds only samples of an earlier drive with later stamps.
    if (status == dssm::ReadStatus::too_old && newest != newest_at_start_) return std::nullopt;
    const dssm::MonoTime now = dssm::MonoClock::now();
    if (now >= deadline) return std::nullopt;
    (void)reader_.wait_for_tid(newest + 1, std::min(deadline, now + kSlice));
  }
  return std::nullopt;
}

}  // namespace vehicle
