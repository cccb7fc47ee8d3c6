// SPDX-License-Identifier: Apache-2.0
//
// This PC's clock, with what dssmd knows of how far it may be from the fleet's (docs/clocks.md).
#pragma once

#include <dssm/clock_status.hpp>
#include <dssm/time.hpp>

#pragma GCC visibility push(default)  // the library hides everything else
namespace dssm::clock {

struct Reading {
  Time time;      // by this PC's clock
  Time earliest;  // the fleet's time lies between these two, both within;
  Time latest;    // the ends of what a Time holds when nothing is known
  Duration clock_error = kUnknownClockError;  // >= 0: time - earliest, latest - time
  ClockStatus status = ClockStatus::unknown;
};

// The time now. Takes what a Session of this process has brought: without one, or when dssmd is
// gone for more than some seconds, nothing is known of the clock.
//   threads  any; async-signal-safe
//   cost     clock_gettime and some loads
Reading now() noexcept;

}  // namespace dssm::clock
#pragma GCC visibility pop
