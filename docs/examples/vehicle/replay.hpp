// SPDX-License-Identifier: Apache-2.0
//
// The times of a replay: when each sample is written, and its stamp. The encoder and the lidar are
// separate processes that do not communicate; they are synchronized because both get the same start
// time and speed.
#pragma once

#include <dssm/result.hpp>
#include <dssm/time.hpp>
#include <limits>
#include <optional>
#include <string>

namespace CLI {
class App;
}

namespace vehicle {

struct ReplayOptions {
  std::string log;
  double speed = 1;   // log seconds per second; 0: without pauses
  double from_s = 0;  // seconds of the log, both included
  double to_s = std::numeric_limits<double>::infinity();
  double life_s = 60;                // history to keep, in seconds of the log
  std::optional<double> start_at_s;  // wall clock, seconds since 1970: when from_s is due
  std::string stamps;                // "now", "recording"; empty: now if start_at_s is given

  void add_to(CLI::App& app);
};

class Replay {
 public:
  // Fails with invalid_argument when the options contradict each other.
  static dssm::Result<Replay> from(const ReplayOptions& options);

  // Sleeps until the log's second `log_s` is due; false when a signal asks to stop.
  bool wait_until(double log_s) const;

  // The stamp of a sample at the log's second `log_s`.
  dssm::Time stamp(double log_s) const;

  // The difference of the stamps [s] of two samples that are `log_s` seconds apart in the log.
  double in_stamps(double log_s) const { return log_s / stamp_speed_; }

 private:
  double speed_ = 1;
  double from_s_ = 0;
  double stamp_speed_ = 1;    // log seconds per second between stamps
  dssm::Time first_stamp_{};  // stamp of log second stamp_zero_s_
  double stamp_zero_s_ = 0;
  dssm::MonoTime due_{};  // when from_s_ is due
};

}  // namespace vehicle
