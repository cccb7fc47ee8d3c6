// SPDX-License-Identifier: Apache-2.0
//
// Times and durations: a point on the wall clock, a point on the monotonic clock, and a duration.
// The compiler refuses to mix them. All count nanoseconds in a signed 64-bit integer. The points
// are those of std::chrono::system_clock and steady_clock, so that what a program has in these
// types needs no conversion.
//
//   threads  any; now() and deadline_in() call clock_gettime() and are async-signal-safe
#pragma once

#if __cplusplus < 202002L
#error "libdssm needs C++20: compile with -std=c++20 or a later standard"
#endif

#include <chrono>
#include <cstdint>
#include <ctime>
#include <type_traits>

#pragma GCC visibility push(default)  // the library hides everything else
namespace dssm {

using Duration = std::chrono::nanoseconds;

namespace detail {

// A clock of the operating system with the members that <chrono> requires. `PointClock` is the
// clock whose time points it has: itself (void), or a standard clock that counts from the same
// moment.
template <clockid_t kClock, bool kSteady, class PointClock = void>
struct PosixClock {
  using duration = Duration;
  using rep = duration::rep;
  using period = duration::period;
  using time_point = std::chrono::time_point<
      std::conditional_t<std::is_void_v<PointClock>, PosixClock, PointClock>, Duration>;
  // NOLINTNEXTLINE(readability-identifier-naming): the name that std::chrono requires
  static constexpr bool is_steady = kSteady;
  static time_point now() noexcept {
    timespec ts{};
    ::clock_gettime(kClock, &ts);
    return time_point(std::chrono::seconds(ts.tv_sec) + Duration(ts.tv_nsec));
  }
};

}  // namespace detail

// CLOCK_REALTIME: nanoseconds since 1970-01-01 00:00 UTC. Can be stepped; used for the times of
// samples only.
using WallClock = detail::PosixClock<CLOCK_REALTIME, false, std::chrono::system_clock>;

// CLOCK_MONOTONIC: nanoseconds since boot. Never steps; used for deadlines and timeouts.
using MonoClock = detail::PosixClock<CLOCK_MONOTONIC, true, std::chrono::steady_clock>;

// A std::chrono::system_clock::time_point where that counts nanoseconds, as in libstdc++; one that
// counts something coarser converts to it by itself.
using Time = WallClock::time_point;
// A std::chrono::steady_clock::time_point, which counts CLOCK_MONOTONIC on Linux.
using MonoTime = MonoClock::time_point;
static_assert(std::is_same_v<MonoTime, std::chrono::steady_clock::time_point>);

// The bound on a time's error when nothing is known about its clock.
inline constexpr Duration kUnknownClockError = Duration::max();

// Instead of a bound: the time is not of the writing PC's clock but of a recording, or of a device
// with a clock of its own, so the bound of the PC's clock does not apply to it.
inline constexpr Duration kForeignClockError = Duration::max() - Duration(1);

// For writers: the time is of this PC's clock, whose bound dssmd knows.
inline constexpr Duration kOwnClockError = Duration(-1);

// No deadline.
inline constexpr MonoTime kNever = MonoTime::max();

// No maximum age: a read by time returns a sample however long before the requested time it is.
inline constexpr Duration kAnyAge = Duration::max();

// Nanoseconds since 1970 to a Time and back.
constexpr Time time_from_ns(std::int64_t ns) noexcept { return Time(Duration(ns)); }
constexpr std::int64_t to_ns(Time t) noexcept { return t.time_since_epoch().count(); }
constexpr std::int64_t to_ns(Duration d) noexcept { return d.count(); }

// The deadline `d` from now; a duration that would overflow gives kNever.
inline MonoTime deadline_in(Duration d) noexcept {
  const MonoTime now = MonoClock::now();
  return d > kNever - now ? kNever : now + d;
}

}  // namespace dssm
#pragma GCC visibility pop
