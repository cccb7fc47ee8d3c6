// SPDX-License-Identifier: Apache-2.0
//
// How far a PC's clock may be from what it follows: the formulas, without state and without I/O.
// All results err upwards. docs/clocks.md "The bound" derives them.
//
//   offset           this clock minus what chronyd takes for the right time; positive: it is ahead
//   root dispersion  what may have gone wrong by drift and jitter on the way from the root, >= 0
//   root delay       round trip to the root of the clocks, >= 0; half of it may be on one way
//   kUnknownClockError stands for "no bound", and is what everything becomes that overflows.
#pragma once

#include <cstdint>
#include <dssm/time.hpp>

#include "core/base/bound_sum.hpp"

namespace dssm::clock {

// How far a clock runs away, in billionths (ns per second): 50 ppm are 50,000.
using PartsPerBillion = std::int64_t;

// What stands between a clock and the root of its time.
struct RootDistance {
  Duration dispersion{};
  Duration delay{};

  friend bool operator==(const RootDistance& a, const RootDistance& b) = default;
};

using dssm::sum;

// Distance from the time that the clock's root has (UTC): |offset| + dispersion + delay / 2.
Duration bound_to_root(Duration offset, const RootDistance& own) noexcept;

// Distance from the clock of the PC that `own` comes by, when that one is `reference` from the same
// root: |offset| + difference of dispersions + difference of delays / 2. A reference that claims to
// be farther from the root than we are takes nothing away: such a difference counts as none.
Duration bound_to_reference(Duration offset, const RootDistance& own,
                            const RootDistance& reference) noexcept;

// What `drift` adds in `age`. An age below 0 adds nothing: the reading is as good as new.
Duration growth(Duration age, PartsPerBillion drift) noexcept;

}  // namespace dssm::clock
