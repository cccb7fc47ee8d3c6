// SPDX-License-Identifier: Apache-2.0
//
// The start is a time of the wall clock, which all processes share. It is converted once to the
// monotonic clock, so a step of the wall clock during the drive does not disturb the replay.
#include "replay.hpp"

#include <CLI/CLI.hpp>
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <ctime>

#include "stop.hpp"

namespace vehicle {
namespace {

dssm::Duration nanoseconds(double seconds) {
  return dssm::Duration(static_cast<std::int64_t>(std::llround(seconds * 1e9)));
}

}  // namespace

void ReplayOptions::add_to(CLI::App& app) {
  app.add_option("--log", log, "the recording: a CARMEN log, plain or .gz")->required();
  app.add_option("--speed", speed, "how many times faster than real time; 0: without pauses")
      ->check(CLI::Range(0.0, 10000.0))
      ->capture_default_str();
  app.add_option("--from", from_s, "first second of the log to play")->capture_default_str();
  app.add_option("--to", to_s, "last second of the log to play (default: its end)");
  app.add_option("--life", life_s, "history to keep in the ring, in seconds of the log")
      ->check(CLI::Range(1.0, 100000.0))
      ->capture_default_str();
  app.add_option("--start-at", start_at_s,
                 "wall-clock time of the start in seconds since 1970, the same for encoder and "
                 "lidar: $(($(date +%s) + 2)) (default: at once)");
  app.add_option("--stamps", stamps,
                 "recording: the log's times, the same in every run; now: the time of the replay "
                 "(default: now with --start-at, otherwise recording)")
      ->check(CLI::IsMember({"recording", "now"}));
}

dssm::Result<Replay> Replay::from(const ReplayOptions& options) {
  const bool stamps_now =
      options.stamps.empty() ? options.start_at_s.has_value() : options.stamps == "now";
  if (stamps_now && !options.start_at_s) {
    return dssm::Error{dssm::Errc::invalid_argument,
                       "--stamps now: encoder and lidar need the same start; add "
                       "'--start-at $(($(date +%s) + 2))', with one value for both"};
  }
  if (!(options.from_s < options.to_s)) {
    return dssm::Error{dssm::Errc::invalid_argument, "--from " + std::to_string(options.from_s) +
                                                         " --to " + std::to_string(options.to_s) +
                                                         ": an empty part; --to must be "
                                                         "later than --from"};
  }
  Replay replay;
  replay.speed_ = options.speed;
  replay.from_s_ = options.from_s;
  const dssm::Time wall_now = dssm::WallClock::now();
  const dssm::Time start =
      options.start_at_s ? dssm::Time(nanoseconds(*options.start_at_s)) : wall_now;
  replay.due_ = dssm::MonoClock::now() + (start - wall_now);
  if (stamps_now) {
    replay.first_stamp_ = start;
    replay.stamp_zero_s_ = options.from_s;
    // A replay without pauses has no speed; the stamps advance as at speed 1.
    replay.stamp_speed_ = options.speed > 0 ? options.speed : 1;
  }
  return replay;
}

bool Replay::wait_until(double log_s) const {
  const dssm::MonoTime due =
      speed_ > 0 ? due_ + nanoseconds((log_s - from_s_) / speed_) : dssm::MonoTime(due_);
  for (;;) {
    if (stop_requested()) return false;
    const dssm::MonoTime now = dssm::MonoClock::now();
    if (now >= due) return true;
    const std::int64_t wake_ns = dssm::to_ns(std::min(due, now + kSlice).time_since_epoch());
    const timespec wake{static_cast<std::time_t>(wake_ns / 1'000'000'000),
                        static_cast<long>(wake_ns % 1'000'000'000)};
    ::clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &wake, nullptr);
  }
}

dssm::Time Replay::stamp(double log_s) const {
  return first_stamp_ + nanoseconds((log_s - stamp_zero_s_) / stamp_speed_);
}

}  // namespace vehicle
