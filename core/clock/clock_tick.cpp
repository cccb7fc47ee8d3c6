// SPDX-License-Identifier: Apache-2.0
#include "core/clock/clock_tick.hpp"

#include <time.h>

namespace dssm::clock {
namespace {

Duration read(clockid_t clock) noexcept {
  timespec time{};
  ::clock_gettime(clock, &time);  // cannot fail for a clock that exists
  return std::chrono::seconds(time.tv_sec) + std::chrono::nanoseconds(time.tv_nsec);
}

}  // namespace

std::optional<Tick> Tick::last() noexcept {
  const Duration before = read(CLOCK_MONOTONIC_COARSE);
  const Duration wall = read(CLOCK_REALTIME_COARSE);
  if (read(CLOCK_MONOTONIC_COARSE) != before) return std::nullopt;
  return Tick{MonoTime(before), wall - before};
}

}  // namespace dssm::clock
