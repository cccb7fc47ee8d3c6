// SPDX-License-Identifier: Apache-2.0
//
// The value that a stream had at a time between two of its samples.
//
//   if (const auto around = reader.read_neighbours(t)) {
//     const auto pose = dssm::interpolate(around->before, around->after, t);
//
// Of a type that is described (DSSM_DESCRIBE), floating-point fields are interpolated linearly, and
// all else is the nearer sample's: integers, enums, bools, text, and what is not described. That is
// wrong for an angle, which may pass from 359 degrees to 1. For a type with angles, quaternions or
// the like, write a function in its namespace:
//
//   Pose dssm_interpolate(const Pose& before, const Pose& after, double fraction)
//
// It returns the value at `fraction` of the way from `before` (0) to `after` (1).
//
//   threads  any
#pragma once

#include <algorithm>
#include <cmath>
#include <concepts>
#include <cstring>
#include <dssm/describe.hpp>
#include <dssm/sample_or.hpp>
#include <vector>

#pragma GCC visibility push(default)  // the library hides everything else
namespace dssm {

// A type with a dssm_interpolate() of its own.
template <class T>
concept Interpolated = requires(const T& sample) {
  { dssm_interpolate(sample, sample, 0.5) } -> std::same_as<T>;
};

namespace detail {

// How far `t` is on the way from `before` to `after`; before <= t <= after. 1 if all are equal:
// then `after` is the newest sample with time <= t, as RawReader::read_at() chooses.
inline double fraction_of(Time t, Time before, Time after) noexcept {
  // Unsigned, because the distance of two int64 may not fit into one.
  const auto distance = [](Time early, Time late) {
    return static_cast<double>(static_cast<std::uint64_t>(to_ns(late)) -
                               static_cast<std::uint64_t>(to_ns(early)));
  };
  return before == after ? 1 : distance(before, t) / distance(before, after);
}

// The fields of T that can be interpolated.
template <Payload T>
std::vector<Field> floating_point_fields() {
  std::vector<Field> fields = type_of<T>().fields;
  std::erase_if(fields, [](const Field& field) {
    return field.kind != Scalar::float32 && field.kind != Scalar::float64;
  });
  return fields;
}

// Sets the elements of `field`, which are Fs, in `out`, which is a copy of the nearer sample.
template <class F>
void interpolate_field(const Field& field, double fraction, const std::byte* before,
                       const std::byte* after, std::byte* out) noexcept {
  for (std::uint64_t i = 0; i < field.count; ++i) {
    const std::uint64_t at_bytes = field.offset_bytes + i * field.stride_bytes;
    F from, to;
    std::memcpy(&from, before + at_bytes, sizeof(F));
    std::memcpy(&to, after + at_bytes, sizeof(F));
    // Sensors write NaN or infinity for "no value", and there is nothing between that and a value.
    if (!std::isfinite(from) || !std::isfinite(to)) continue;
    const F value = std::lerp(from, to, static_cast<F>(fraction));
    std::memcpy(out + at_bytes, &value, sizeof(F));
  }
}

}  // namespace detail

// The sample at `t`, between two samples of one stream. Its tid is the nearer sample's (of two
// equally near ones the earlier one's), its clock_error the greater one.
//   returns  ok | too_old (`t` is before `before`) | not_yet (`t` is after `after`)
//   cost     no lock, no system call; a copy, and some ns for each floating-point number. The first
//            call for a T also describes it, which allocates memory
template <Payload T>
SampleOr<T> interpolate(const Sample<T>& before, const Sample<T>& after, Time t) {
  return SampleOr<T>([&](Sample<T>& out) {
    if (t < before.time()) return ReadStatus::too_old;
    if (t > after.time()) return ReadStatus::not_yet;
    const double fraction = detail::fraction_of(t, before.time(), after.time());
    out = fraction <= 0.5 ? before : after;
    out.info.time = t;
    out.info.clock_error = std::max(before.clock_error(), after.clock_error());
    if constexpr (Interpolated<T>) {
      out.value = dssm_interpolate(before.value, after.value, fraction);
    } else {
      static_assert(Described<T> || std::is_arithmetic_v<typename detail::ArrayOf<T>::Element>,
                    "this type needs a DSSM_DESCRIBE line, or a function dssm_interpolate()");
      static const std::vector<Field> fields = detail::floating_point_fields<T>();
      const auto* from = reinterpret_cast<const std::byte*>(&before.value);
      const auto* to = reinterpret_cast<const std::byte*>(&after.value);
      auto* at = reinterpret_cast<std::byte*>(&out.value);
      for (const Field& field : fields) {
        if (field.kind == Scalar::float32) {
          detail::interpolate_field<float>(field, fraction, from, to, at);
        } else {
          detail::interpolate_field<double>(field, fraction, from, to, at);
        }
      }
    }
    return ReadStatus::ok;
  });
}

}  // namespace dssm
#pragma GCC visibility pop
