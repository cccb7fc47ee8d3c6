// SPDX-License-Identifier: Apache-2.0
//
// A cheap check whether the wall clock was set. The kernel's coarse clocks are those of its last
// tick, so the difference of the wall clock and the monotonic one stays the same to the nanosecond
// until the wall clock is set (clock_gettime(2); slewing changes both alike). Only the kernel's
// page of times is read.
#pragma once

#include <dssm/time.hpp>

namespace dssm::clock {

struct Tick {
  MonoTime mono;
  Duration difference{};  // of the wall clock from the monotonic one

  // When a tick comes between both readings, the difference is that tick too large. Thread-safe.
  static Tick last() noexcept;
};

}  // namespace dssm::clock
