// SPDX-License-Identifier: Apache-2.0
//
// Search by time: the newest sample with time <= t, exactly, for every sequence of times.
// docs/ring-layout.md "Search by time" explains the structure; in short:
//
//   A run is a longest sequence of samples whose times do not run backwards. A stream with one
//   writer whose clock is never stepped is one run. Inside a run the times are sorted: interpolate
//   between its ends, then bisect. Each run knows its parent, the newest earlier sample whose time
//   is before the run's first: no sample between the parent and the run can be the answer when the
//   run itself has none. Skew-binary jumps (E. W. Myers, "An applicative random-access stack", Inf.
//   Proc. Letters 17, 1983) skip ancestor runs, so even a stream with many runs is searched in
//   O(log depth).
//
// Streams with several writers are why runs are linked: two writers that measure at different times
// and write in turn make a new run with almost every sample. Then at(t) takes 610 ns at a depth of
// 10^5 (docs/benchmarks.md, "every other sample backwards"), where a search from run to run would
// be linear in the depth.
//
// Used by readers, and by the writer that begins a new run.
#pragma once

#include <dssm/sample.hpp>

#include "core/ring/ring_memory.hpp"

namespace dssm::ring {

struct FoundSample {
  ReadStatus status = ReadStatus::too_old;  // ok | too_old | lapped (a slot changed under us)
  Tid tid = kNoTid;
  Tid lowest_probed = kNoTid;  // the result is valid if this tid was still readable afterwards
};

// Newest tid in [oldest, top] with time <= `t_ns`. `run_start` is the start of top's run. All
// numbers that come from slots are checked; a hostile writer gets nonsense or `lapped`, never a
// fault, and at most kMaxHops hops.
FoundSample find_newest_at_or_before(const SlotTable& slots, Tid oldest, Tid top, Tid run_start,
                                     std::int64_t t_ns) noexcept;

// The links that the slot of a run's first sample holds.
struct RunLinks {
  Tid parent = kNoTid;
  Tid jump = kNoTid;
  std::int64_t level = 0;
};

// Links for the run that begins with sample `start` of time `time_ns`, which is earlier than the
// time of sample start - 1; among the samples from `oldest` on. Writer only, under the lock.
RunLinks links_for_new_run(const SlotTable& slots, Tid oldest, Tid start, Tid previous_run_start,
                           std::int64_t time_ns) noexcept;

inline constexpr int kMaxHops = 512;  // log2(2^24) jumps and as many parents, with a wide margin

}  // namespace dssm::ring
