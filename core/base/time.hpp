// SPDX-License-Identifier: Apache-2.0
//
// What the code inside needs of times beyond dssm/time.hpp.
#pragma once

#include <algorithm>
#include <ctime>
#include <dssm/time.hpp>

namespace dssm {

// As system calls take durations and points in time; a negative one is 0.
constexpr timespec timespec_of(Duration duration) noexcept {
  const std::int64_t ns = std::max<std::int64_t>(to_ns(duration), 0);
  return {ns / 1'000'000'000, ns % 1'000'000'000};
}
constexpr timespec timespec_of(MonoTime time) noexcept {
  return timespec_of(time.time_since_epoch());
}

// CLOCK_MONOTONIC_RAW: what the PC's oscillator counts, in nanoseconds by its own speed. No program
// sets or slews it; it stands still while the PC sleeps.
using RawClock = detail::PosixClock<CLOCK_MONOTONIC_RAW, true>;
using RawTime = RawClock::time_point;

constexpr std::int64_t to_ns(RawTime t) noexcept { return t.time_since_epoch().count(); }

// The monotonic clock at the kernel's last tick, some milliseconds ago at most, for a fifth of the
// cost of MonoClock::now(): only the kernel's page of times is read. Thread-safe.
inline MonoTime coarse_now() noexcept {
  using Coarse = detail::PosixClock<CLOCK_MONOTONIC_COARSE, true>;
  return MonoTime(Coarse::now().time_since_epoch());
}

// How long `early` is before `late`, in ns. Unsigned, because the distance of two int64 may not fit
// into one.
constexpr std::uint64_t distance_ns(Time early, Time late) noexcept {
  return static_cast<std::uint64_t>(to_ns(late)) - static_cast<std::uint64_t>(to_ns(early));
}

// Whether a sample of `time` <= t is older at `t` than a read allows.
constexpr bool is_stale(Time t, Time time, Duration max_age) noexcept {
  return max_age != kAnyAge &&
         distance_ns(time, t) >
             static_cast<std::uint64_t>(std::max<std::int64_t>(to_ns(max_age), 0));
}

// a + b for bounds on an error, both >= 0; kUnknownClockError stays that.
constexpr Duration sum(Duration a, Duration b) noexcept {
  return a > kUnknownClockError - b ? kUnknownClockError : a + b;
}

}  // namespace dssm
