// SPDX-License-Identifier: Apache-2.0
//
// "What did the encoder measure when this scan was taken?": the main purpose of DSSM.
#pragma once

#include <dssm/reader.hpp>
#include <optional>

#include "odometry.hpp"
#include "pose.hpp"

namespace vehicle {

class OdometryAt {
 public:
  // `deadline` is the longest time, in real time, that at() waits for the encoder.
  OdometryAt(dssm::Reader<Odometry> reader, dssm::Duration deadline);

  // The vehicle's pose at `t`, interpolated between the readings before and after it. Waits until
  // the later one is written; in a live system this takes at most one cycle. nullopt after the
  // deadline, when the ring no longer holds the earlier reading, or after a signal to stop.
  std::optional<Pose2> at(dssm::Time t);

 private:
  dssm::Reader<Odometry> reader_;
  dssm::Duration deadline_;
  dssm::Tid newest_at_start_;
};

}  // namespace vehicle
