// SPDX-License-Identifier: Apache-2.0
//
// The time of a recording while it is played: it runs at some speed, in both directions, stands
// still, and jumps. It is the PC's playback clock, which other programs may change, too; or, for
// samples that are stamped with the present times, a clock of this program alone.
#pragma once

#include <atomic>
#include <dssm/playback_clock.hpp>
#include <dssm/session.hpp>
#include <dssm/time.hpp>
#include <functional>
#include <memory>
#include <optional>
#include <set>
#include <string>
#include <thread>
#include <utility>

namespace dssm::ctl {

// As PlaybackClock takes times.
inline double seconds_of(Time time) { return static_cast<double>(to_ns(time)) / 1e9; }

// Keeps other players away from this PC's playback clock, and has those of all other hosts follow
// it if asked, in a thread of its own: a host that does not answer delays nothing.
class SharedPlayback {
 public:
  // A change that shall come at the same moment on all hosts is made so long before.
  static constexpr Duration kLead = std::chrono::milliseconds(50);

  // on_failure: gets a sentence for each host that does not follow, once, from the thread
  //   fails  conflict (another player has it), no_permission, unavailable
  static Result<std::unique_ptr<SharedPlayback>> take(
      Session session, PlaybackClock clock, std::function<void(const std::string&)> on_failure);
  // From now on, those of all other hosts follow.
  void share_with_all_hosts() { has_all_hosts_ = true; }
  SharedPlayback(const SharedPlayback&) = delete;
  SharedPlayback& operator=(const SharedPlayback&) = delete;
  ~SharedPlayback();  // the clocks of the other hosts show the real time again

 private:
  // A change that another program makes is found within this time.
  static constexpr Duration kCheckPeriod = std::chrono::milliseconds(5);
  static constexpr Duration kRenewPeriod = std::chrono::seconds(1);
  SharedPlayback(Session session, PlaybackClock clock, std::uint64_t driver,
                 std::function<void(const std::string&)> on_failure);
  void run();
  void share(bool ends);

  Session session_;
  PlaybackClock clock_;
  const std::function<void(const std::string&)> on_failure_;
  const std::uint64_t driver_;
  std::set<std::pair<std::string, Errc>> reported_;  // hosts, and why
  std::atomic<bool> has_all_hosts_ = false;
  std::atomic<bool> ends_ = false;
  std::thread thread_;
};

class Timeline {
 public:
  // To be started. Without `clock`: of this program.
  //   lead  changes come so long after they are made, for other hosts that follow
  explicit Timeline(std::optional<PlaybackClock> clock, Duration lead = {});
  Timeline(const Timeline&) = delete;
  Timeline& operator=(const Timeline&) = delete;
  ~Timeline();  // the playback clock shows the real time again

  Time now() const;
  double speed() const { return clock_ ? clock_->setting().speed : speed_; }  // < 0: backwards
  bool is_paused() const { return clock_ ? clock_->setting().paused : paused_; }

  // None of these is a jump for has_jumped().
  void set_time(Time time) { change(time, {}, {}); }
  void set_speed(double speed) { change({}, speed, {}); }
  void set_paused(bool paused) { change({}, {}, paused); }
  // From then on, all at once.
  void start(Time time, double speed, bool paused) { change(time, speed, paused); }

  // What time it was when the last of these changes came.
  Time changed_at() const { return changed_at_; }

  // Whether another program has set the time since the last call: it is not what it would be if it
  // had run on. A change of speed alone is not a jump.
  bool has_jumped();

  // In real time, how long until it is `time`, if no program changes it; zero when that is over in
  // the direction in which it runs.
  Duration until(Time time) const;

  // The stamp of a sample of `time`: that, or the present time when it is due.
  Time stamp(Time time) const;

 private:
  using Setting = PlaybackClock::Setting;
  Time own_at(Time real) const;
  void change(std::optional<Time> time, std::optional<double> speed, std::optional<bool> paused);

  std::optional<PlaybackClock> clock_;
  const Duration lead_;
  // Of clock_, at the last has_jumped() or since the last change of ours, and a moment just before
  // that. What another program has changed since then is still to be found.
  Setting known_;
  double known_real_s_ = 0;
  Time changed_at_{};
  // Without clock_: at that real time it was so late.
  Time base_real_{}, base_time_{};
  double speed_ = 1;
  bool paused_ = true;
};

}  // namespace dssm::ctl
