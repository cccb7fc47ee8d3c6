// SPDX-License-Identifier: Apache-2.0
//
// When to write what: the pace of a replay and the stamps it gives. The encoder and the lidar are
// processes of their own that never talk to each other; they play together because both are told
// the same moment to start at and the same speed.
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
  double speed = 1;   // log seconds per second; 0: without any pause
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

  // The stamp of what the log says happened at `log_s`.
  dssm::Time stamp(double log_s) const;

  // So many seconds of the log, as a difference of two stamps [s].
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
