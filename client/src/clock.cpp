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
  timespec now{};
  ::clock_gettime(CLOCK_REALTIME, &now);
  return static_cast<double>(now.tv_sec) + static_cast<double>(now.tv_nsec) * 1e-9;
}

// At least 1 ns, so that a sleep for it does not end too early.
Duration duration_of(double seconds) noexcept {
  constexpr double kMaxSeconds = 9e9;
  return Duration(std::llround(std::clamp(seconds, 1e-9, kMaxSeconds) * 1e9));
}

PlaybackClock::Setting setting_of(const clock::PlaybackRun& run) noexcept {
  return {run.offset_s, run.speed, run.paused != 0, run.paused_at_s};
}

// The same run, but it reads `time_s` at `real_s`.
clock::PlaybackRun rebased(clock::PlaybackRun run, double time_s, double real_s) noexcept {
  run.offset_s = time_s - run.speed * real_s;
  run.paused_at_s = time_s;
  return run;
}

// From now on it runs as change(how it runs now, real time) says.
template <class Change>
void change_now(clock::PlaybackRecord& record, Change change) noexcept {
  record.update([&](const clock::PlaybackSetting& setting) {
    const double real_s = real_now_s();
    return clock::PlaybackSetting{change(setting.run_at(real_s), real_s)};
  });
}

}  // namespace

PlaybackClock::PlaybackClock(std::shared_ptr<detail::PlaybackClockState> state) noexcept
    : state_(std::move(state)) {}

PlaybackClock::Setting PlaybackClock::setting() const noexcept {
  const clock::PlaybackSetting setting = state_->record->load();
  // Without a change to come, and so without asking for the time, it is what it was set to.
  return setting_of(setting.change_s > 0 ? setting.run_at(real_now_s()) : setting.run);
}

PlaybackClock::Setting PlaybackClock::next_setting() const noexcept {
  return setting_of(state_->record->load().run);
}

double PlaybackClock::now_s() const noexcept { return state_->record->at(real_now_s()); }

WaitStatus PlaybackClock::sleep_until(double time_s) const noexcept {
  constexpr double kMaxSleepSeconds = 0.01;
  for (;;) {
    const double real_s = real_now_s();
    const clock::PlaybackRun run = state_->record->load().run_at(real_s);
    const double missing_s = time_s - run.at(real_s);
    const double speed = run.speed;
    if (speed < 0 ? missing_s >= 0 : missing_s <= 0) return WaitStatus::ready;
    if (const auto slept = sleep_in_lockstep(duration_of(missing_s))) {
      if (*slept == WaitStatus::interrupted) return *slept;
      continue;
    }
    const double rest_s = run.paused || speed == 0 ? kMaxSleepSeconds : missing_s / speed;
    const timespec sleep = timespec_of(duration_of(std::min(rest_s, kMaxSleepSeconds)));
    if (::nanosleep(&sleep, nullptr) != 0) return WaitStatus::interrupted;
  }
}

void PlaybackClock::reset() noexcept {
  change_now(*state_->record, [](const auto&, double) { return clock::PlaybackRun{}; });
}

void PlaybackClock::set_time(double time_s) noexcept {
  change_now(*state_->record, [&](const clock::PlaybackRun& run, double real_s) {
    return rebased(run, time_s, real_s);
  });
}

void PlaybackClock::set_offset(double offset_s) noexcept {
  change_now(*state_->record, [&](clock::PlaybackRun run, double) {
    run.offset_s = offset_s;
    return run;
  });
}

void PlaybackClock::set_speed(double speed) noexcept {
  change_now(*state_->record, [&](clock::PlaybackRun run, double real_s) {
    const double time_s = run.at(real_s);
    run.speed = speed;
    return rebased(run, time_s, real_s);
  });
}

void PlaybackClock::set_paused(bool paused) noexcept {
  change_now(*state_->record, [&](clock::PlaybackRun run, double real_s) {
    const double time_s = run.at(real_s);
    run.paused = paused;
    return rebased(run, time_s, real_s);
  });
}

PlaybackClock::Setting PlaybackClock::change_at(Time from, std::optional<double> time_s,
                                                std::optional<double> speed,
                                                std::optional<bool> paused) noexcept {
  clock::PlaybackRun run;
  const bool changed = state_->record->update([&](const clock::PlaybackSetting& setting) {
    const double now_s = real_now_s();
    const double from_s = std::max(static_cast<double>(to_ns(from)) * 1e-9, now_s);
    const clock::PlaybackRun before = setting.run_at(now_s);
    run = before;
    run.speed = speed.value_or(run.speed);
    run.paused = paused.value_or(run.paused != 0);
    run = rebased(run, time_s.value_or(before.at(from_s)), from_s);
    return clock::PlaybackSetting{run, from_s, before};
  });
  return changed ? setting_of(run) : setting();
}

}  // namespace dssm
