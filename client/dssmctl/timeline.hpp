// SPDX-License-Identifier: Apache-2.0
//
// The time of a recording while it is played: it runs at some speed, in both directions, stands
// still, and jumps. It is the PC's playback clock, which other programs may change, too; or, for
// samples that are stamped with the present times, a clock of this program alone.
#pragma once

#include <dssm/playback_clock.hpp>
#include <dssm/time.hpp>
#include <optional>

namespace dssm::ctl {

class Timeline {
 public:
  // Stands still at 1970. Without `clock`: of this program.
  explicit Timeline(std::optional<PlaybackClock> clock);
  Timeline(const Timeline&) = delete;
  Timeline& operator=(const Timeline&) = delete;
  ~Timeline();  // the playback clock shows the real time again

  Time now() const;
  double speed() const { return clock_ ? clock_->setting().speed : speed_; }  // < 0: backwards
  bool is_paused() const { return clock_ ? clock_->setting().paused : paused_; }

  // None of these is a jump for has_jumped().
  void set_time(Time time);
  void set_speed(double speed);
  void set_paused(bool paused);

  // Whether another program has set the time since the last call: it is not what it would be if it
  // had run on. A change of speed alone is not a jump.
  bool has_jumped();

  // In real time, how long until it is `time`, if nobody changes it; zero when that is over in the
  // direction in which it runs.
  Duration until(Time time) const;

  // The stamp of a sample of `time`: that, or the present time when it is due.
  Time stamp(Time time) const;

 private:
  using Setting = PlaybackClock::Setting;
  Time own_at(Time real) const;
  void known_from_now_on();

  std::optional<PlaybackClock> clock_;
  Setting known_;            // of clock_, at the last has_jumped() or change of ours
  double known_real_s_ = 0;  // when
  // Without clock_: at that real time it was so late.
  Time base_real_{}, base_time_{};
  double speed_ = 1;
  bool paused_ = true;
};

}  // namespace dssm::ctl
