// SPDX-License-Identifier: Apache-2.0
//
// "What did the encoder measure when this scan was taken?": the main purpose of DSSM.
#pragma once

#include <cstdint>
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
  std::optional<Pose2> between(dssm::Time t, const dssm::Neighbours& readings);
  // Moves the reader to a restarted stream's new ring, which find_neighbours() does not do because
  // it does not move the cursor. True if there was a restart.
  bool follow_restart();

  dssm::Reader<Odometry> reader_;
  dssm::Duration deadline_;
  dssm::Tid newest_at_start_;
  std::uint64_t restarts_ = 0;  // of the reader, handled so far
};

}  // namespace vehicle
