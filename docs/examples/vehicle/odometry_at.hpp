// SPDX-License-Identifier: Apache-2.0
//
// "What did the encoder say when this scan was taken?": the question that DSSM is for.
#pragma once

#include <cstdint>
#include <dssm/reader.hpp>
#include <optional>

#include "odometry.hpp"
#include "pose.hpp"

namespace vehicle {

class OdometryAt {
 public:
  // `deadline` is how long at() waits for the encoder at most, by the clock on the wall of the
  // laboratory: a replay at a higher speed needs less.
  OdometryAt(dssm::Reader<Odometry> reader, dssm::Duration deadline);

  // The vehicle's pose at `t`, in proportion between the readings before and after it. When the
  // later one is not written yet, waits for it; in a live system it comes within one cycle.
  // nullopt when it does not come in time, when the ring no longer holds the earlier one, or when
  // a signal asks to stop.
  std::optional<Pose2> at(dssm::Time t);

 private:
  std::optional<Pose2> between(dssm::Time t, const dssm::Neighbours& readings);
  // True, once, when the stream began anew. neighbours() leaves the reader where it is, on the old
  // ring; a read that moves the cursor goes on with the new one.
  bool goes_on_with_new_ring();

  dssm::Reader<Odometry> reader_;
  dssm::Duration deadline_;
  dssm::Tid newest_at_start_;
  std::uint64_t restarts_ = 0;  // of the reader, as far as noticed here
};

}  // namespace vehicle
