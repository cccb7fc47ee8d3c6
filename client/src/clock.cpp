// SPDX-License-Identifier: Apache-2.0
//
// The clocks of the public API: this PC's (clock::now()) and the playback clock.
#include <algorithm>
#include <cmath>
#include <ctime>
#include <dssm/clock.hpp>
#include <dssm/playback_clock.hpp>

#include "client/src/client.hpp"
#include "client/src/states.hpp"
#include "core/base/time.hpp"

namespace dssm::clock {

Reading now() noexcept {
  Reading reading;
  reading.time = WallClock::now();
  reading.earliest = Time::min();
  reading.latest = Time::max();
  const ClockPage* page = detail::latest_clock_page().load(std::memory_order_acquire);
  if (!page) return reading;
  reading.clock_error = clock_error_at(*page, reading.time).value_or(kUnknownClockError);
  reading.status = status_of(*page);
  if (reading.clock_error == kUnknownClockError) return reading;
  reading.earliest = reading.time - reading.clock_error;
  reading.latest = reading.time + reading.clock_error;
  return reading;
}

}  // namespace dssm::clock

namespace dssm {
namespace {

// Rounded as gettimeSSM_real() rounds it: or a clock that was set to a time could show, right after
// that, one that is a step of the number's resolution (0.24 us) earlier.
double real_now_s() noexcept {
  const std::int64_t ns = to_ns(WallClock::now()), seconds = ns / 1'000'000'000;
  return static_cast<double>(seconds) + static_cast<double>(ns - seconds * 1'000'000'000) * 1e-9;
}

// At least 1 ns, so that a sleep for it comes to an end behind what it waits for.
Duration duration_of(double seconds) noexcept {
  constexpr double kMax_s = 9e9;
  return Duration(std::llround(std::clamp(seconds, 1e-9, kMax_s) * 1e9));
}

// The same setting with another rate, so that the clock reads the same now.
clock::PlaybackSetting rebased(clock::PlaybackSetting setting, double time_s,
                               double real_s) noexcept {
  setting.offset_s = time_s - setting.speed * real_s;
  setting.paused_at_s = time_s;
  return setting;
}

}  // namespace

PlaybackClock::PlaybackClock(std::shared_ptr<detail::PlaybackClockState> state) noexcept
    : state_(std::move(state)) {}

PlaybackClock::Setting PlaybackClock::setting() const noexcept {
  const clock::PlaybackSetting now = state_->record->load();
  return {now.offset_s, now.speed, now.paused != 0, now.paused_at_s};
}

double PlaybackClock::now_s() const noexcept { return state_->record->load().at(real_now_s()); }

WaitStatus PlaybackClock::sleep_until(double time_s) const noexcept {
  constexpr double kMaxSleep_s = 0.01;
  for (;;) {
    const clock::PlaybackSetting setting = state_->record->load();
    const double missing_s = time_s - setting.at(real_now_s());
    const double speed = setting.speed;
    if (speed < 0 ? missing_s >= 0 : missing_s <= 0) return WaitStatus::ready;
    if (const auto slept = sleep_in_lockstep(duration_of(missing_s))) {
      if (*slept == WaitStatus::interrupted) return *slept;
      continue;
    }
    const double rest_s = setting.paused || speed == 0 ? kMaxSleep_s : missing_s / speed;
    const timespec sleep = timespec_of(duration_of(std::min(rest_s, kMaxSleep_s)));
    if (::nanosleep(&sleep, nullptr) != 0) return WaitStatus::interrupted;
  }
}

void PlaybackClock::reset() noexcept {
  state_->record->update([](const clock::PlaybackSetting&) { return clock::PlaybackSetting{}; });
}

void PlaybackClock::set_time(double time_s) noexcept {
  state_->record->update([&](const clock::PlaybackSetting& setting) {
    return rebased(setting, time_s, real_now_s());
  });
}

void PlaybackClock::set_offset(double offset_s) noexcept {
  state_->record->update([&](clock::PlaybackSetting setting) {
    setting.offset_s = offset_s;
    return setting;
  });
}

void PlaybackClock::set_speed(double speed) noexcept {
  state_->record->update([&](clock::PlaybackSetting setting) {
    const double real_s = real_now_s();
    const double time_s = setting.at(real_s);
    setting.speed = speed;
    return rebased(setting, time_s, real_s);
  });
}

void PlaybackClock::set_paused(bool paused) noexcept {
  state_->record->update([&](clock::PlaybackSetting setting) {
    const double real_s = real_now_s();
    const double time_s = setting.at(real_s);
    setting.paused = paused;
    return rebased(setting, time_s, real_s);
  });
}

}  // namespace dssm
