// SPDX-License-Identifier: Apache-2.0
//
// The PC's shared playback clock (SSM time): `speed * real time + offset`, or frozen while paused.
// All programs of this PC's dssmd share one record. Any program that may connect to dssmd may
// change it, and all see the change at once. Players of recordings set it; programs that work on
// recorded times read it.
//
//   threads  any thread may call any function; setting(), next_setting() and now_s() are
//            async-signal-safe
//   cost     setting() and now_s() take no lock; now_s() calls clock_gettime()
//   moved    a moved-from object may only be assigned to or destroyed
//   errors   none: Session::open_playback_clock() reports what can fail
#pragma once

#include <dssm/sample.hpp>
#include <dssm/time.hpp>
#include <memory>
#include <optional>

namespace dssm::detail {
struct PlaybackClockState;
}

#pragma GCC visibility push(default)  // the library hides everything else
namespace dssm {

// A handle; copies share one clock. Times are seconds since 1970 as a double, as in SSM.
class PlaybackClock {
 public:
  struct Setting {
    double offset_s = 0;
    double speed = 1;  // negative: runs backwards; 0: stands still
    bool paused = false;
    double paused_at_s = 0;  // SSM time while paused
    bool operator==(const Setting&) const = default;
  };

  // The present setting, never a mix of two; asks for the time only after change_at().
  Setting setting() const noexcept;

  // What it is after a change that is to come (change_at()); else setting().
  Setting next_setting() const noexcept;

  // SSM time now [s]: paused_at_s while paused, else speed * CLOCK_REALTIME + offset_s.
  double now_s() const noexcept;

  // Waits until now_s() has reached `time_s`, in the direction in which the clock runs: while it is
  // paused or stands still, that is not. Follows each change of the clock within 10 ms.
  //   returns  ready | interrupted (a signal handler ran)
  WaitStatus sleep_until(double time_s) const noexcept;

  // reset(), set_time() and set_offset() may change now_s() at once; set_speed() and set_paused()
  // do not. A robust lock serialises all setters: a process that is killed inside one leaves the
  // old or the new setting. One that is stopped there keeps the others waiting for 2 s; then they
  // change nothing.
  void reset() noexcept;                  // offset 0, speed 1, not paused
  void set_time(double time_s) noexcept;  // SSM time becomes `time_s` now, paused or not
  void set_offset(double offset_s) noexcept;
  void set_speed(double speed) noexcept;
  void set_paused(bool paused) noexcept;

  // The same at the real time `from`, which may be to come by some seconds at most: so several
  // hosts can change it at the same moment (Session::share_playback_clock()). Until then it runs
  // as it does now. Empty: unchanged. Replaces a change that is still to come.
  //   returns  what it is then, if no program changes it again
  Setting change_at(Time from, std::optional<double> time_s, std::optional<double> speed,
                    std::optional<bool> paused) noexcept;

 private:
  friend class Session;
  explicit PlaybackClock(std::shared_ptr<detail::PlaybackClockState> state) noexcept;
  std::shared_ptr<detail::PlaybackClockState> state_;
};

// For programs that sleep by the playback clock in another way than sleep_until(): `dssmctl play
// --lockstep` runs a program in steps, in which the clock advances only while all of it waits.
// Sleeps for `playback_time`.
//   returns  timeout | interrupted (a signal handler ran); empty: the program is not run in steps,
//            and nothing was done
//   threads  any
std::optional<WaitStatus> sleep_in_lockstep(Duration playback_time) noexcept;

}  // namespace dssm
#pragma GCC visibility pop
