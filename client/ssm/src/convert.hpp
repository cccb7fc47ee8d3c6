// SPDX-License-Identifier: Apache-2.0
//
// From SSM's arguments and results to DSSM's, and back: names, ring sizes, tids, times.
#pragma once

#include <cstddef>
#include <cstdint>
#include <dssm/sample.hpp>
#include <dssm/stream.hpp>
#include <dssm/time.hpp>
#include <limits>
#include <optional>
#include <string>
#include <string_view>

#include "core/base/seconds.hpp"
#include "core/base/ssm_log.hpp"

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

// The type of a stream of `bytes` per sample.
TypeInfo type_for(std::size_t bytes);

// Bytes per sample as SSM programs see it.
inline std::uint64_t data_bytes(const TypeInfo& type) noexcept {
  return type.name == kEmptySsmType ? 0 : type.payload_bytes;
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
// SSM's times are doubles of seconds (core/base/seconds.hpp).

inline constexpr std::int64_t kSecond = 1'000'000'000;

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
