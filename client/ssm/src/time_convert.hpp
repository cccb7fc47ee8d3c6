// SPDX-License-Identifier: Apache-2.0
//
// SSM's times are doubles of seconds, the ring's are 64-bit nanoseconds. A present-day double has
// steps of 238 ns, so the way there and back gives the same double; times near zero are kept to the
// nanosecond. All comparisons of times happen in nanoseconds.
#pragma once

#include <cmath>
#include <cstdint>
#include <dssm/time.hpp>
#include <limits>

namespace dssm::ssm {

inline constexpr std::int64_t kSecond = 1'000'000'000;

// The nearest nanosecond; beyond 64 bits (years 1677 to 2262) the end of the range; 0 for NaN.
inline std::int64_t ns_from_seconds(double seconds) noexcept {
  constexpr double kEnd = 9'223'372'036.0;  // the last whole second that fits
  if (std::isnan(seconds)) return 0;
  if (seconds >= kEnd) return std::numeric_limits<std::int64_t>::max();
  if (seconds <= -kEnd) return std::numeric_limits<std::int64_t>::min();
  // Apart, because seconds * 1e9 has no bits left for single nanoseconds.
  const double whole = std::floor(seconds);
  return static_cast<std::int64_t>(whole) * kSecond + std::llround((seconds - whole) * 1e9);
}

// The double nearest to that many nanoseconds.
inline double seconds_from_ns(std::int64_t ns) noexcept {
  constexpr std::int64_t kExact = std::int64_t{1} << 53;  // up to here the quotient rounds once
  if (-kExact < ns && ns < kExact) return static_cast<double>(ns) / 1e9;
  const std::int64_t whole = ns / kSecond;
  return static_cast<double>(whole) + static_cast<double>(ns - whole * kSecond) / 1e9;
}

inline Time time_from_seconds(double seconds) noexcept {
  return time_from_ns(ns_from_seconds(seconds));
}
inline double seconds_from_time(Time time) noexcept { return seconds_from_ns(to_ns(time)); }

}  // namespace dssm::ssm
