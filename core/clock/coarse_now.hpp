// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <dssm/time.hpp>

namespace dssm::clock {

// The monotonic clock at the kernel's last tick, some milliseconds ago at most, for a fifth of the
// cost of MonoClock::now(): only the kernel's page of times is read. Thread-safe.
inline MonoTime coarse_now() noexcept {
  using Coarse = detail::PosixClock<CLOCK_MONOTONIC_COARSE, true>;
  return MonoTime(Coarse::now().time_since_epoch());
}

}  // namespace dssm::clock
