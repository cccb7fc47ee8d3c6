// SPDX-License-Identifier: Apache-2.0
//
// This PC's clock, and the bound on its distance from the fleet's reference (docs/clocks.md).
#pragma once

#include <dssm/clock_status.hpp>
#include <dssm/time.hpp>

#pragma GCC visibility push(default)  // the library hides everything else
namespace dssm::clock {

struct Reading {
  Time time;      // of this PC's clock
  Time earliest;  // the reference's time is from `earliest` to `latest`, both included;
  Time latest;    // Time::min() and Time::max() while the bound is unknown
  Duration clock_error = kUnknownClockError;  // >= 0: time - earliest, latest - time
  ClockStatus status = ClockStatus::unknown;
};

// The time now with its bound. The bound comes from dssmd through a Session of this process: it is
// unknown without a Session, and after dssmd has been unavailable for some seconds.
//   threads  any thread; async-signal-safe
//   cost     clock_gettime and some loads
Reading now() noexcept;

}  // namespace dssm::clock
#pragma GCC visibility pop
