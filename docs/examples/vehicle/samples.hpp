// SPDX-License-Identifier: Apache-2.0
//
// The payloads of the other streams. DSSM_DESCRIBE lets `dssmctl echo` show fields by name.
#pragma once

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <dssm/describe.hpp>
#include <dssm/sample.hpp>
#include <span>

#include "carmen_log.hpp"

namespace vehicle {

inline constexpr char kOdometryStream[] = "odometry";
inline constexpr char kScanStream[] = "lidar";
inline constexpr char kPoseStream[] = "pose";

// Stream "lidar". A sample's time is that of the scan. A sample without beams is the end mark: the
// lidar has stopped, and readers may stop, too.
struct Scan {
  std::int32_t beams;        // how many of range_m are used
  float first_rad;           // direction of range_m[0] from straight ahead, counter-clockwise
  float step_rad;            // from each beam to the next
  float range_m[kMaxBeams];  // infinite without a reflection

  bool is_end() const { return beams == 0; }

  // The used part of range_m; stays within range_m for any value of `beams`.
  std::span<const float> ranges() const {
    return std::span<const float>(range_m).first(
        std::min(static_cast<std::size_t>(std::max(beams, 0)), kMaxBeams));
  }
};
DSSM_DESCRIBE(Scan, beams, first_rad, step_rad, range_m)

// Stream "pose": the laser's pose. A sample's time is that of its scan.
struct Pose {
  double x_m, y_m, theta_rad;
  std::int64_t scan_tid;  // kNoTid: the end mark

  bool is_end() const { return scan_tid == dssm::kNoTid; }
};
DSSM_DESCRIBE(Pose, x_m, y_m, theta_rad, scan_tid)

}  // namespace vehicle
