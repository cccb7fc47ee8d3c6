// SPDX-License-Identifier: Apache-2.0
//
// Reads a recording in the CARMEN logger's text format, plain or gzip-compressed: odometry from
// ODOM lines, LIDAR scans from FLASER lines (data/README.md describes both).
//
// Real recordings have bad lines, so no line is fatal: each unusable line is skipped and counted by
// reason, and the first one is kept for the summary.
#pragma once

#include <cstddef>
#include <dssm/result.hpp>
#include <string>
#include <string_view>
#include <vector>

#include "pose.hpp"

namespace vehicle {

struct OdometryReading {
  double time_s = 0;  // since the start of the log
  Pose2 pose;
};

struct ScanReading {
  double time_s = 0;            // since the start of the log
  std::vector<float> ranges_m;  // over the front half circle, from right to left; infinite
                                // without a reflection (ROS, REP 117)
  Pose2 laser;                  // the laser's pose according to the log's scan matcher
};

// Counts of skipped lines.
struct Skipped {
  std::size_t unstamped = 0;   // ODOM lines with timestamp 0: the logger's echo of a scan's pose
  std::size_t misstamped = 0;  // timestamps far from those of the surrounding lines
  std::size_t bad = 0;         // torn, not a number, unknown
  std::string first_bad;       // "line 7: ...", empty without one
};

struct CarmenLog {
  std::vector<OdometryReading> odometry;  // in order of time
  std::vector<ScanReading> scans;         // in order of time
  Skipped skipped;

  // "4934 odometry readings and 4791 scans; left out: ...": one line for people.
  std::string summary() const;
};

// The maximum number of beams of a scan: half a degree apart over a half circle, both ends
// included.
inline constexpr std::size_t kMaxBeams = 361;

// Never fails: a text without a usable line gives an empty log.
CarmenLog parse_carmen_log(std::string_view text);

// Fails with not_found or system when the file cannot be read or decompressed, and with
// invalid_argument when it contains no usable line.
dssm::Result<CarmenLog> read_carmen_log(const std::string& path);

}  // namespace vehicle
