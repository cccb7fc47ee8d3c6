// SPDX-License-Identifier: Apache-2.0
//
// How often samples come to a ring, and whether they still do, by the stamps of its newest samples
// and this PC's clock: the figures that lists of streams show. The owner's dssmd computes them, so
// the clocks of other PCs do not count.
//
// docs/glossary.md "pause", "stalled" has the words; dssm/stream.hpp the definition of a pause.
//
// A sample may be up to a second old when it is written, because it was processed since it was
// measured: no pause is shorter.
#pragma once

#include <dssm/stream.hpp>

#include "core/ring/ring_reader.hpp"

namespace dssm::ring {

// Sets oldest, newest, newest_time, rate_hz, age and state of `info` from the ring; its cycle must
// be set. What is not known keeps its value. A stream whose newest sample is as old as a pause is
// stalled; the rate is that after the newest pause. The state is unknown when the stamps are of
// another clock than the owner's (a recording's, a device's). Cost: the stamps of kRecentSamples.
//   now  the wall clock of this PC, which owns the ring
void describe_activity(const RingReader& reader, Time now, StreamInfo& info) noexcept;

}  // namespace dssm::ring
