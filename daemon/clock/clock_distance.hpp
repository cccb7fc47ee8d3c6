// SPDX-License-Identifier: Apache-2.0
//
// How far the clocks of two hosts may be apart. Each statement about such a pair is a bound that
// holds by itself, so the least of several statements counts. There is one source of statements:
// the reports of both hosts, whose sync chains meet in a clock or in UTC. Another source, such as a
// measurement between the two, would be combined with it here and nowhere else: FleetClock calls
// these two functions for every assessment and for the distance that programs are shown.
// docs/clocks.md "Between two PCs" derives them.
#pragma once

#include <dssm/time.hpp>

#include "core/wire/clock_report.hpp"

namespace dssm::clock {

// How far two clocks may be apart, both reports being of the same moment: 0 for one kernel, else
// the shortest way by a clock that both follow, or by UTC. kUnknownClockError: there is no such
// way.
Duration distance(const wire::ClockReport& one, const wire::ClockReport& other) noexcept;

// How far the time of a sample by `writer`'s clock may be from `reader`'s clock, beyond the
// sample's own clock error (a bound against `writer.anchor`). kUnknownClockError: there is no way.
// Not for clocks that are shared: those have no distance, whatever the clock error.
Duration distance_from_anchor(const wire::ClockReport& writer,
                              const wire::ClockReport& reader) noexcept;

}  // namespace dssm::clock
