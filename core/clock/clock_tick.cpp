// SPDX-License-Identifier: Apache-2.0
#include "core/clock/clock_tick.hpp"

namespace dssm::clock {

std::optional<Tick> Tick::last() noexcept {
  using Mono = detail::PosixClock<CLOCK_MONOTONIC_COARSE, true>;
  using Wall = detail::PosixClock<CLOCK_REALTIME_COARSE, false>;
  const Duration before = Mono::now().time_since_epoch();
  const Duration wall = Wall::now().time_since_epoch();
  if (Mono::now().time_since_epoch() != before) return std::nullopt;
  return Tick{MonoTime(before), wall - before};
}

}  // namespace dssm::clock
