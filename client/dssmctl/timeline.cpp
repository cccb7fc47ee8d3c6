// SPDX-License-Identifier: Apache-2.0
#include "client/dssmctl/timeline.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <random>

#include "client/dssmctl/text.hpp"
#include "core/base/try.hpp"

namespace dssm::ctl {
namespace {

Duration scaled(Duration duration, double factor) {
  constexpr double kMaxNs = 9e18;
  return Duration(
      std::llround(std::clamp(static_cast<double>(to_ns(duration)) * factor, -kMaxNs, kMaxNs)));
}

double at(const PlaybackClock::Setting& setting, double real_s) {
  return setting.paused ? setting.paused_at_s : setting.speed * real_s + setting.offset_s;
}

Time time_from_seconds(double seconds) {
  constexpr double kMaxSeconds = 9e9;  // 285 years: a Time has no more
  return time_from_ns(std::llround(std::clamp(seconds, -kMaxSeconds, kMaxSeconds) * 1e9));
}

}  // namespace

Result<std::unique_ptr<SharedPlayback>> SharedPlayback::take(
    Session session, PlaybackClock clock, std::function<void(const std::string&)> on_failure) {
  const std::uint64_t driver = std::random_device()() | 1U;
  DSSM_TRY(session.hold_playback_clock(driver));
  return std::unique_ptr<SharedPlayback>(
      new SharedPlayback(std::move(session), std::move(clock), driver, std::move(on_failure)));
}

SharedPlayback::SharedPlayback(Session session, PlaybackClock clock, std::uint64_t driver,
                               std::function<void(const std::string&)> on_failure)
    : session_(std::move(session)),
      clock_(std::move(clock)),
      on_failure_(std::move(on_failure)),
      driver_(driver),
      thread_([this] { run(); }) {}

SharedPlayback::~SharedPlayback() {
  ends_ = true;
  thread_.join();
}

void SharedPlayback::run() {
  PlaybackClock::Setting shared;
  MonoTime next{};
  for (; !ends_; std::this_thread::sleep_for(kCheckPeriod)) {
    const PlaybackClock::Setting setting = clock_.next_setting();
    if (setting == shared && MonoClock::now() < next) continue;
    shared = setting;
    next = deadline_in(kRenewPeriod);
    share(false);
  }
  share(true);
}

void SharedPlayback::share(bool ends) {
  const auto report = [&](const std::string& host, const Error& error) {
    if (ends || !reported_.emplace(host, error.code).second) return;
    const std::string reason = escaped_message(error.message);
    on_failure_(host.empty() ? reason
                             : fmt::format("the playback clock of '{}' does not follow: {}",
                                           escaped(host), reason));
  };
  if (!has_all_hosts_) {
    if (Result<void> held = session_.hold_playback_clock(driver_, ends); !held) {
      report({}, held.error());
    }
    return;
  }
  const auto followers = session_.share_playback_clock(driver_, ends);
  if (!followers) return report({}, followers.error());
  for (const PlaybackFollower& follower : *followers) {
    if (follower.error) report(follower.host, *follower.error);
  }
}

Timeline::Timeline(std::optional<PlaybackClock> clock, Duration lead)
    : clock_(std::move(clock)), lead_(lead) {}

Timeline::~Timeline() {
  if (clock_) clock_->reset();
}

void Timeline::change(std::optional<Time> time, std::optional<double> speed,
                      std::optional<bool> paused) {
  if (clock_) {
    const Time from = WallClock::now() + lead_;
    known_real_s_ = seconds_of(from);
    known_ = clock_->change_at(from, time ? std::optional(seconds_of(*time)) : std::nullopt, speed,
                               paused);
    changed_at_ = time_from_seconds(at(known_, known_real_s_));
    // What follows here works on what is then.
    if (lead_ > Duration::zero()) std::this_thread::sleep_for(lead_);
    return;
  }
  changed_at_ = base_time_ = time.value_or(now());
  base_real_ = WallClock::now();
  speed_ = speed.value_or(speed_);
  paused_ = paused.value_or(paused_);
}

Time Timeline::own_at(Time real) const {
  if (paused_) return base_time_;
  return saturating_add(base_time_, scaled(saturating_sub(real, base_real_), speed_));
}

Time Timeline::now() const {
  if (!clock_) return own_at(WallClock::now());
  return time_from_seconds(clock_->now_s());
}

bool Timeline::has_jumped() {
  if (!clock_) return false;
  const Setting before = known_;
  const double before_s = known_real_s_;
  // Before the setting is read: a change after that moment is found at the next call.
  known_real_s_ = seconds_of(WallClock::now());
  known_ = clock_->setting();
  const double now_s = seconds_of(WallClock::now());
  // It was changed at some moment in between, from what it was to what it is.
  const double began = at(before, before_s), would_be = at(before, now_s);
  const double speed = known_.paused ? 0 : known_.speed;
  const double as_of_now = began + speed * (now_s - before_s);
  const double is = at(known_, now_s);
  constexpr double kToleranceSeconds = 1e-3;
  const auto [least, greatest] = std::minmax({began, would_be, as_of_now});
  return is < least - kToleranceSeconds || is > greatest + kToleranceSeconds;
}

Duration Timeline::until(Time time) const {
  const double speed = this->speed();
  const Duration rest = saturating_sub(time, now());
  if (speed < 0 ? rest >= Duration::zero() : rest <= Duration::zero()) return Duration::zero();
  if (is_paused() || speed == 0) return Duration::max();
  return scaled(rest, 1 / speed);
}

Time Timeline::stamp(Time time) const {
  if (clock_) return time;
  if (paused_) return WallClock::now();
  return saturating_add(base_real_, scaled(saturating_sub(time, base_time_), 1 / speed_));
}

}  // namespace dssm::ctl
