// SPDX-License-Identifier: Apache-2.0
//
// Search by time: the newest sample with time <= t, exactly, for every sequence of times.
// docs/ring-layout.md "Search by time" explains the structure; in short:
//
//   A run is a longest stretch of samples whose times do not run backwards. A stream whose clock is
//   never stepped is one run. Inside a run the times are sorted: interpolate between its ends, then
//   gallop, then bisect. Each run knows its parent, the newest earlier sample that lies before the
//   run's first time: nothing between the parent and the run can be the answer to a question that
//   the run itself could not answer. Ancestor runs are skipped over by skew-binary jumps
//   (E. W. Myers, "An applicative random-access stack", Inf. Proc. Letters 17, 1983), so even a
//   stream that steps backwards all the time is searched in O(log depth).
//
// Used by readers, and by the writer that begins a new run.
#pragma once

#include <dssm/sample.hpp>

#include "core/ring/slot_table.hpp"

namespace dssm::ring {

struct FoundSample {
  ReadStatus status = ReadStatus::too_old;  // ok | too_old | lapped (a slot changed under us)
  Tid tid = kNoTid;
  Tid lowest_probed = kNoTid;  // the result holds if this tid was still readable afterwards
};

// Newest tid in [oldest, top] with time <= `t_ns`. `run_start` is the start of top's run. All
// numbers that come from slots are checked; a hostile writer gets nonsense or `lapped`, never a
// fault, and at most kMaxHops hops.
FoundSample find_newest_at_or_before(const SlotTable& slots, Tid oldest, Tid top, Tid run_start,
                                     std::int64_t t_ns) noexcept;

// What the slot of a run's first sample says about the run.
struct RunLinks {
  Tid parent = kNoTid;
  Tid jump = kNoTid;
  std::int64_t level = 0;
};

// Links for the run that begins with sample `start` of time `time_ns`, which is earlier than the
// time of sample start - 1. Writer only, under the lock.
RunLinks links_for_new_run(const SlotTable& slots, Tid start, Tid previous_run_start,
                           std::int64_t time_ns) noexcept;

inline constexpr int kMaxHops = 512;  // log2(2^24) jumps and as many parents, with much room

}  // namespace dssm::ring
