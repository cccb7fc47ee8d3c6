// SPDX-License-Identifier: Apache-2.0
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

}  // namespace dssm
