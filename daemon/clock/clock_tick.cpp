// SPDX-License-Identifier: Apache-2.0
#include "daemon/clock/clock_tick.hpp"

#include "core/base/time.hpp"

namespace dssm::clock {

[[gnu::hot]] Tick Tick::last() noexcept {
  using Wall = detail::PosixClock<CLOCK_REALTIME_COARSE, false>;
  const MonoTime mono = coarse_now();
  const Duration wall = Wall::now().time_since_epoch();
  return {mono, wall - mono.time_since_epoch()};
}

}  // namespace dssm::clock
