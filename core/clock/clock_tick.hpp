// SPDX-License-Identifier: Apache-2.0
//
// A cheap look at whether the wall clock was set. The kernel's coarse clocks are those of its last
// tick, so the difference of the wall clock and the monotonic one is the same number to the
// nanosecond until somebody sets the wall clock (clock_gettime(2); slewing changes both alike).
// Nothing but the kernel's page of times is read.
#pragma once

#include <dssm/time.hpp>

namespace dssm::clock {

struct Tick {
  MonoTime mono;
  Duration difference{};  // of the wall clock from the monotonic one

  // When a tick comes while we look, the difference is that tick too large. Thread-safe.
  static Tick last() noexcept;
};

}  // namespace dssm::clock
