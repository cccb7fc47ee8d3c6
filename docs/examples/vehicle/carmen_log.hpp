// SPDX-License-Identifier: Apache-2.0
//
// Reads a recording in the CARMEN logger's text format, plain or gzip-compressed: odometry from
// ODOM lines, LIDAR scans from FLASER lines (data/README.md describes both).
//
// Real recordings are dirty, so nothing in a file is fatal: each line that cannot be used is left
// out, counted by reason, and the first one of them is kept for the report.
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
  std::vector<float> ranges_m;  // over the front half circle, from right to left
  Pose2 laser;                  // where the log's own scan matcher saw the laser
};

// Lines that were left out.
struct Skipped {
  std::size_t unstamped = 0;   // ODOM lines with timestamp 0: the logger's echo of a scan's pose
  std::size_t misstamped = 0;  // timestamps far from those of the lines around them
  std::size_t bad = 0;         // torn, not a number, unknown
  std::string first_bad;       // "line 7: ...", empty without one
};

struct CarmenLog {
  std::vector<OdometryReading> odometry;  // in order of time
  std::vector<ScanReading> scans;         // in order of time
  Skipped skipped;

  // "4934 odometry readings and 4791 scans; left out: ...": one line for a person.
  std::string summary() const;
};

// The most beams a scan may have: half a degree apart over a half circle, both ends included.
inline constexpr std::size_t kMaxBeams = 361;

// Never fails: a text without a usable line gives an empty log.
CarmenLog parse_carmen_log(std::string_view text);

// Fails with not_found or system when the file cannot be read or decompressed, and with
// invalid_argument when it holds no usable line.
dssm::Result<CarmenLog> read_carmen_log(const std::string& path);

}  // namespace vehicle
