// SPDX-License-Identifier: Apache-2.0
#include "client/dssmctl/timeline.hpp"

#include <algorithm>
#include <cmath>

#include "client/dssmctl/output.hpp"

namespace dssm::ctl {
namespace {

double seconds_of(Time time) { return static_cast<double>(to_ns(time)) / 1e9; }

Duration scaled(Duration duration, double factor) {
  constexpr double kMax_ns = 9e18;
  return Duration(
      std::llround(std::clamp(static_cast<double>(to_ns(duration)) * factor, -kMax_ns, kMax_ns)));
}

double at(const PlaybackClock::Setting& setting, double real_s) {
  return setting.paused ? setting.paused_at_s : setting.speed * real_s + setting.offset_s;
}

}  // namespace

Timeline::Timeline(std::optional<PlaybackClock> clock) : clock_(std::move(clock)) {
  set_paused(true);
}

Timeline::~Timeline() {
  if (clock_) clock_->reset();
}

void Timeline::known_from_now_on() {
  if (!clock_) return;
  known_ = clock_->setting();
  known_real_s_ = seconds_of(WallClock::now());
}

Time Timeline::own_at(Time real) const {
  if (paused_) return base_time_;
  return saturating_add(base_time_, scaled(saturating_sub(real, base_real_), speed_));
}

Time Timeline::now() const {
  if (!clock_) return own_at(WallClock::now());
  constexpr double kMax_s = 9e9;  // 285 years: a Time has no more
  return time_from_ns(std::llround(std::clamp(clock_->now_s(), -kMax_s, kMax_s) * 1e9));
}

void Timeline::set_time(Time time) {
  if (clock_) clock_->set_time(seconds_of(time));
  base_real_ = WallClock::now();
  base_time_ = time;
  known_from_now_on();
}

void Timeline::set_speed(double speed) {
  if (clock_) {
    clock_->set_speed(speed);
  } else {
    set_time(now());
  }
  speed_ = speed;
  known_from_now_on();
}

void Timeline::set_paused(bool paused) {
  if (clock_) {
    clock_->set_paused(paused);
  } else {
    set_time(now());
  }
  paused_ = paused;
  known_from_now_on();
}

bool Timeline::has_jumped() {
  if (!clock_) return false;
  const Setting before = known_;
  const double before_s = known_real_s_;
  known_from_now_on();
  // It was changed at some moment in between, from what it was to what it is.
  const double began = at(before, before_s), would_be = at(before, known_real_s_);
  const double speed = known_.paused ? 0 : known_.speed;
  const double as_of_now = began + speed * (known_real_s_ - before_s);
  const double is = at(known_, known_real_s_);
  constexpr double kTolerance_s = 1e-3;
  const auto [least, greatest] = std::minmax({began, would_be, as_of_now});
  return is < least - kTolerance_s || is > greatest + kTolerance_s;
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
