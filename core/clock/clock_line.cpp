// SPDX-License-Identifier: Apache-2.0
#include "core/clock/clock_line.hpp"

namespace dssm::clock {

std::optional<Time> ClockLine::at(RawTime t) const noexcept {
  // A line may begin after `t`: it is of another PC, whose RawClock is known within bounds.
  if (!exists() || t < raw - kMaxAge || t > raw + kMaxAge) return std::nullopt;
  const Duration age = t - raw;
  return wall + age +
         Duration(static_cast<std::int64_t>(static_cast<double>(age.count()) *
                                            static_cast<double>(rate) / 1e9));
}

}  // namespace dssm::clock
