// SPDX-License-Identifier: Apache-2.0
//
// From SSM's arguments and results to DSSM's, and back: names, ring sizes, tids, times.
#pragma once

#include <cmath>
#include <cstddef>
#include <cstdint>
#include <dssm/sample.hpp>
#include <dssm/stream.hpp>
#include <dssm/time.hpp>
#include <limits>
#include <optional>
#include <string>
#include <string_view>

namespace dssm::ssm {

// --- streams

// "'lidar' [0]", as SSM's messages have it.
std::string quoted(std::string_view name, int id);

// "lidar@pc2" names a stream and its host; the limits of names are for what is before the '@'.
std::size_t name_length(const char* name) noexcept;
StreamId stream_id(const char* name, int id);

// Slots of a ring, before truncation.
double slots(double life, double cycle) noexcept;

// What is wrong with the arguments of createSSM; nothing when they are valid.
std::optional<std::string> wrong_arguments(const char* name, int id, double life, double cycle);

// What to report when a property has another size than the program's type for it.
std::string property_size_error(const std::string& quoted_name, std::size_t property_bytes,
                                std::size_t program_bytes);

// Of valid arguments.
History history_of(double life, double cycle) noexcept;

// Type name of a stream created with size 0; its ring has one byte, as rings must.
inline constexpr const char* kEmptyType = "ssm.empty";

// The type of a stream of `bytes` per sample.
TypeInfo type_for(std::size_t bytes);

// Bytes per sample as SSM programs see it.
inline std::uint64_t data_bytes(const TypeInfo& type) noexcept {
  return type.name == kEmptyType ? 0 : type.payload_bytes;
}

// --- tids
//
// SSM's tids are ints, the ring's have 64 bits. A program sees the lower 31 bits: after 2147483647
// comes 0 again, and a stream written at 1 kHz lives on after 24.8 days. While a stream is younger
// than that, both are the same number.

inline constexpr Tid kTidMask = std::numeric_limits<std::int32_t>::max();

inline int ssm_tid(Tid tid) noexcept { return tid < 0 ? -1 : static_cast<int>(tid & kTidMask); }

// The ring's tid that a program means by `tid` >= 0 while the newest is `newest`: the one of those
// with these 31 bits that is closest to it.
inline Tid ring_tid(int tid, Tid newest) noexcept {
  if (newest <= kTidMask) return tid;
  const Tid older = (newest - tid) & kTidMask;
  return older <= kTidMask / 2 ? newest - older : newest + (kTidMask + 1 - older);
}

// --- times
//
// SSM's times are doubles of seconds, the ring's are 64-bit nanoseconds. A present-day double has
// steps of 238 ns, so the way there and back gives the same double; times near zero are kept to the
// nanosecond. All comparisons of times happen in nanoseconds.

inline constexpr std::int64_t kSecond = 1'000'000'000;

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
  return whole * kSecond + static_cast<std::int64_t>(rest_ns + 0.5);
}

// The double nearest to that many nanoseconds.
inline double seconds_from_ns(std::int64_t ns) noexcept {
  constexpr std::int64_t kExact = std::int64_t{1} << 53;  // up to here the quotient rounds once
  if (-kExact < ns && ns < kExact) return static_cast<double>(ns) / 1e9;
  // Not divided, which takes longer: what that rounds otherwise is 10^-8 ns, and whole nanoseconds
  // are never closer than 6 * 10^-5 ns to the middle between two doubles of today.
  const std::int64_t whole = ns / kSecond;
  return static_cast<double>(whole) + static_cast<double>(ns - whole * kSecond) * 1e-9;
}

inline Time time_from_seconds(double seconds) noexcept {
  return time_from_ns(ns_from_seconds(seconds));
}
inline double seconds_from_time(Time time) noexcept { return seconds_from_ns(to_ns(time)); }

// The greatest time before `seconds`: at most one nanosecond less. getTID() finds samples there.
inline Time time_before(double seconds) noexcept {
  const Time time = time_from_seconds(seconds);
  return time > Time::min() ? time - Duration(1) : time;
}

}  // namespace dssm::ssm
