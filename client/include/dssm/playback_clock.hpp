// SPDX-License-Identifier: Apache-2.0
//
// The PC's shared playback clock (SSM time): `speed * real time + offset`, or frozen while paused.
// One record for all programs of this PC's dssmd; anyone who may connect may change it and all see
// it at once. Players of recordings turn it; programs that read log time follow it.
//
//   threads  all functions may be called from any thread, readers also from signal handlers
//   cost     reading takes no lock and makes no system call beyond clock_gettime
#pragma once

#include <memory>

#pragma GCC visibility push(default)  // the library hides everything else
namespace dssm {

namespace detail {
struct PlaybackClockState;
}

// Seconds since 1970 as a double, as SSM programs use them.
class PlaybackClock {
 public:
  struct Setting {
    double offset_s = 0;
    double speed = 1;  // negative runs backwards, 0 stands
    bool paused = false;
    double paused_at_s = 0;  // the frozen time; meaningful while paused
  };

  // The setting as one consistent whole, never a mix of two.
  Setting setting() const noexcept;

  // SSM time now [s]: paused_at_s while paused, else speed * CLOCK_REALTIME + offset_s.
  double now_s() const noexcept;

  // All setters keep the clock continuous unless they set the time itself. They are serialised by a
  // robust lock; a process killed inside one leaves the old or the new setting.
  void reset() noexcept;                  // offset 0, speed 1, not paused
  void set_time(double time_s) noexcept;  // SSM time becomes `time_s` now, paused or not
  void set_offset(double offset_s) noexcept;
  void set_speed(double speed) noexcept;
  void set_paused(bool paused) noexcept;

 private:
  friend class Session;
  explicit PlaybackClock(std::shared_ptr<detail::PlaybackClockState> state) noexcept;
  std::shared_ptr<detail::PlaybackClockState> state_;
};

}  // namespace dssm
#pragma GCC visibility pop
