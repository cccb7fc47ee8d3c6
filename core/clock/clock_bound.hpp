// SPDX-License-Identifier: Apache-2.0
//
// How far a PC's clock may be from what it follows: the formulas, without state and without I/O.
// All results are rounded upwards. docs/clocks.md "The bound" derives them.
//
//   offset           this clock minus chronyd's estimate of the right time; positive: it is ahead
//   root dispersion  error by drift and jitter on the way from the root, >= 0
//   root delay       round trip to the root of the clocks, >= 0; half of it may be on one way
//   kUnknownClockError is "no bound", and the result of each sum that overflows.
#pragma once

#include <cstdint>
#include <dssm/clock_status.hpp>

#include "core/base/time.hpp"

namespace dssm::clock {

// How fast a clock drifts, in billionths (ns per second): 50 ppm are 50,000.
using PartsPerBillion = std::int64_t;

using dssm::sum;

// Distance from the time that the clock's root has (UTC): |offset| + dispersion + delay / 2.
Duration bound_to_root(Duration offset, const RootDistance& own) noexcept;

// Distance from the clock of the PC that `own` comes by, when that one is `reference` from the same
// root: |offset| + difference of dispersions + difference of delays / 2. A reference that claims to
// be farther from the root than this clock reduces nothing: a difference below zero counts as zero.
Duration bound_to_reference(Duration offset, const RootDistance& own,
                            const RootDistance& reference) noexcept;

// What `drift` adds in `age`. An age below 0 adds nothing.
Duration growth(Duration age, PartsPerBillion drift) noexcept;

// What a clock that runs faster than another by `rate` gains on it in `age`, or loses if negative.
Duration gained(Duration age, PartsPerBillion rate) noexcept;

}  // namespace dssm::clock
