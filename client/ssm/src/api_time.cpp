// SPDX-License-Identifier: Apache-2.0
//
// <ssm-time.h>, and the control of the clock in <libssm.h>. Everything here but opentimeSSM and
// createtimeSSM may be called from signal handlers.
#include <cerrno>
#include <cmath>
#include <ctime>
#include <dssm/playback_clock.hpp>

#include "../include/libssm.h"
#include "convert.hpp"
#include "process.hpp"

using dssm::PlaybackClock;
using dssm::ssm::process;

namespace {

PlaybackClock::Setting setting() noexcept { return process().clock().setting(); }

// 1, or 0 without a clock.
template <class Change>
int set(Change change) noexcept {
  return process().clock().change(change) ? 1 : 0;
}

// Real time per SSM time of a sleep.
double sleep_factor() noexcept {
  const double speed = std::fabs(setting().speed);
  return speed > 0 && std::isfinite(speed) ? 1 / speed : 1;
}

int sleep_scaled(double seconds, double& left) noexcept {
  if (!(seconds >= 0)) {  // NaN too
    errno = EINVAL;
    return -1;
  }
  const double begin = gettimeSSM();
  const dssm::Duration playback_time(dssm::ns_from_seconds(seconds));
  if (const auto slept = dssm::sleep_in_lockstep(playback_time)) {
    left = std::fmax(seconds - (gettimeSSM() - begin), 0);
    if (*slept == dssm::WaitStatus::timeout) return 0;
    errno = EINTR;
    return -1;
  }
  const double factor = sleep_factor();
  constexpr double kMaxSeconds = 4e9;  // 126 years: long enough, and fits
  const double real = std::fmin(seconds * factor, kMaxSeconds);
  const double whole = std::floor(real);
  timespec span{};
  span.tv_sec = static_cast<time_t>(whole);
  span.tv_nsec = static_cast<long>((real - whole) * 1e9);
  timespec rest{};
  if (::nanosleep(&span, &rest) == 0) return 0;
  left = (static_cast<double>(rest.tv_sec) + static_cast<double>(rest.tv_nsec) * 1e-9) / factor;
  return -1;
}

}  // namespace

extern "C" {

ssmTimeT gettimeSSM_real(void) {
  timespec now{};
  ::clock_gettime(CLOCK_REALTIME, &now);
  return static_cast<double>(now.tv_sec) + static_cast<double>(now.tv_nsec) * 1e-9;
}

[[gnu::flatten]] ssmTimeT gettimeSSM(void) {
  const auto now = process().clock().now_s();
  return now ? *now : gettimeSSM_real();
}

unsigned int sleepSSM(double sec) {
  double left = 0;
  return static_cast<unsigned int>(sleep_scaled(sec, left));
}

int usleepSSM(unsigned int usec) {
  double left = 0;
  return sleep_scaled(usec * 1e-6, left);
}

int nanosleepSSM(const struct timespec* req, struct timespec* rem) {
  if (req->tv_sec < 0 || req->tv_nsec < 0 || req->tv_nsec >= 1'000'000'000) {
    errno = EINVAL;
    return -1;
  }
  double left = 0;
  const int result = sleep_scaled(
      static_cast<double>(req->tv_sec) + static_cast<double>(req->tv_nsec) * 1e-9, left);
  if (result != 0 && rem) {
    rem->tv_sec = static_cast<time_t>(left);
    rem->tv_nsec = static_cast<long>((left - std::floor(left)) * 1e9);
  }
  return result;
}

int opentimeSSM(void) { return process().attach_clock() ? 1 : 0; }

void closetimeSSM(void) { process().clock().detach(); }

int createtimeSSM(void) { return opentimeSSM(); }

int destroytimeSSM(void) {
  closetimeSSM();
  return 1;
}

void inittimeSSM(void) {
  set([](PlaybackClock& clock) { clock.reset(); });
}

int settimeSSM(ssmTimeT now) {
  return set([&](PlaybackClock& clock) { clock.set_time(now); });
}

int settimeSSM_speed(double speed) {
  return set([&](PlaybackClock& clock) { clock.set_speed(speed); });
}

double gettimeSSM_speed(void) { return setting().speed; }

int settimeSSM_is_pause(int is_pause) {
  return set([&](PlaybackClock& clock) { clock.set_paused(is_pause != 0); });
}

int gettimeSSM_is_pause(void) { return setting().paused ? 1 : 0; }

int settimeSSM_is_reverse(int is_reverse) {
  const double speed = gettimeSSM_speed();
  return (is_reverse != 0) == (speed < 0) || speed == 0 ? 1 : settimeSSM_speed(-speed);
}

int gettimeSSM_is_reverse(void) { return gettimeSSM_speed() < 0 ? 1 : 0; }

ssmTimeT gettimeOffset(void) { return setting().offset_s; }

void settimeOffset(ssmTimeT offset) {
  set([&](PlaybackClock& clock) { clock.set_offset(offset); });
}

}  // extern "C"
