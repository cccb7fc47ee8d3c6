// SPDX-License-Identifier: Apache-2.0
//
// SSM's times are doubles of seconds, the ring's are 64-bit nanoseconds. A present-day double has
// steps of 238 ns, so the way there and back gives the same double; times near zero are kept to the
// nanosecond. All comparisons of times happen in nanoseconds.
#pragma once

#include <cmath>
#include <cstdint>
#include <limits>

namespace dssm {

inline constexpr std::int64_t kSecondNs = 1'000'000'000;

// The nearest nanosecond; beyond 64 bits (years 1677 to 2262) the end of the range; 0 for NaN.
inline std::int64_t ns_from_seconds(double seconds) noexcept {
  constexpr double kEnd = 9'223'372'036.0;  // the last whole second that fits
  if (std::isnan(seconds)) return 0;
  if (seconds >= kEnd) return std::numeric_limits<std::int64_t>::max();
  if (seconds <= -kEnd) return std::numeric_limits<std::int64_t>::min();
  // Apart, because seconds * 1e9 has no bits left for single nanoseconds. Not by std::floor and
  // std::llround, which are calls, in each read and write of a sample.
  auto whole = static_cast<std::int64_t>(seconds);
  if (static_cast<double>(whole) > seconds) --whole;
  const double rest_ns = (seconds - static_cast<double>(whole)) * 1e9;
  // NOLINTNEXTLINE(bugprone-incorrect-roundings): >= 0, and of many bits less than a double has
  return whole * kSecondNs + static_cast<std::int64_t>(rest_ns + 0.5);
}

// Whether a sample can have this time: not NaN, and within 64 bits of nanoseconds.
inline bool is_sample_time(double seconds) noexcept {
  const std::int64_t ns = ns_from_seconds(seconds);
  return !std::isnan(seconds) && ns != std::numeric_limits<std::int64_t>::max() &&
         ns != std::numeric_limits<std::int64_t>::min();
}

// The double nearest to that many nanoseconds.
inline double seconds_from_ns(std::int64_t ns) noexcept {
  constexpr std::int64_t kExact = std::int64_t{1} << 53;  // up to here the quotient rounds once
  if (-kExact < ns && ns < kExact) return static_cast<double>(ns) / 1e9;
  // Not divided, which takes longer: what that rounds otherwise is 10^-8 ns, and whole nanoseconds
  // are never closer than 6 * 10^-5 ns to the middle between two doubles of today.
  const std::int64_t whole = ns / kSecondNs;
  return static_cast<double>(whole) + static_cast<double>(ns - whole * kSecondNs) * 1e-9;
}

}  // namespace dssm
