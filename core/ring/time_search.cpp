// SPDX-License-Identifier: Apache-2.0
#include "core/ring/time_search.hpp"

#include <algorithm>

#include "core/ring/copy.hpp"

namespace dssm::ring {
namespace {

// Probes the time index and remembers how far back it looked.
class Probe {
 public:
  Probe(const SlotTable& slots, Tid top) noexcept : slots_(slots), lowest_(top) {}

  std::int64_t time(Tid tid) noexcept {
    lowest_ = std::min(lowest_, tid);
    return slots_.time_ns(tid).load(kProbe);  // the caller calls fence_after_probing()
  }
  // Fetches the slot of a likely answer while its time is compared.
  void prefetch(Tid tid) const noexcept {
    const SlotHeader& slot = slots_.slot(tid);
    __builtin_prefetch(&slot);
    __builtin_prefetch(&slot + 1);  // the payload's first line
  }
  void touch(Tid tid) noexcept { lowest_ = std::min(lowest_, tid); }
  Tid lowest() const noexcept { return lowest_; }

 private:
  const SlotTable& slots_;
  Tid lowest_;
};

// Where t lies between the two ends, as if the times between them were evenly spaced.
Tid interpolate(Tid low, Tid high, std::int64_t low_ns, std::int64_t high_ns,
                std::int64_t t_ns) noexcept {
  // Differences may be as wide as the whole range of int64. Those of doubles would be too coarse:
  // the times of today are 256 ns apart there.
  const auto after_low = [low_ns](std::int64_t time_ns) {
    return static_cast<double>(static_cast<std::uint64_t>(time_ns) -
                               static_cast<std::uint64_t>(low_ns));
  };
  const double share = after_low(t_ns) / after_low(high_ns);
  const Tid guess = low + static_cast<Tid>(share * static_cast<double>(high - low));
  return std::clamp(guess, low, high - 1);
}

// Newest tid in [low, high] with time <= t. The times in between are sorted, time(low) <= t is
// known; low_ns and high_ns are the times of the ends, high_ns > t.
Tid search_run(Probe& probe, Tid low, Tid high, std::int64_t low_ns, std::int64_t high_ns,
               std::int64_t t_ns) noexcept {
  // A regular stream needs one step: the guess is right, or its neighbour is. A second step helps
  // streams with a gap; more would only delay the bisection of irregular ones.
  for (int step = 0; step < 2 && high - low > 1; ++step) {
    const Tid guess = interpolate(low, high, low_ns, high_ns, t_ns);
    if (step == 0) probe.prefetch(guess);
    const std::int64_t guess_ns = probe.time(guess);
    Tid width = 1;
    if (guess_ns <= t_ns) {
      low = guess, low_ns = guess_ns;
      for (; high - low > 1; width *= 2) {
        const Tid next = std::min(low + width, high - 1);
        const std::int64_t next_ns = probe.time(next);
        if (next_ns > t_ns) {
          high = next, high_ns = next_ns;
          break;
        }
        low = next, low_ns = next_ns;
        if (width >= 4) break;  // the guess was far off: interpolate again, or bisect
      }
    } else {
      high = guess, high_ns = guess_ns;
      for (; high - low > 1; width *= 2) {
        const Tid next = std::max(high - width, low + 1);
        const std::int64_t next_ns = probe.time(next);
        if (next_ns <= t_ns) {
          low = next, low_ns = next_ns;
          break;
        }
        high = next, high_ns = next_ns;
        if (width >= 4) break;
      }
    }
  }
  while (high - low > 1) {
    const Tid middle = low + (high - low) / 2;
    (probe.time(middle) <= t_ns ? low : high) = middle;
  }
  return low;
}

// Reads one field of the slot of sample `tid`; false when the slot holds another sample by now.
bool load_field(const SlotTable& slots, Tid tid, std::atomic<std::int64_t> SlotHeader::*field,
                std::int64_t& value) noexcept {
  SlotHeader& slot = slots.slot(tid);
  const std::uint64_t sequence = slot.sequence.load(std::memory_order_acquire);
  if (sequence != published_sequence(tid) && sequence != lost_sequence(tid)) return false;
  value = (slot.*field).load(std::memory_order_acquire);
  return slot.sequence.load(std::memory_order_relaxed) == sequence;
}

}  // namespace

FoundSample find_newest_at_or_before(const SlotTable& slots, Tid oldest, Tid top, Tid run_start,
                                     std::int64_t t_ns) noexcept {
  Probe probe(slots, top);
  FoundSample found;
  Tid last = top;         // the answer is not newer than this
  Tid start = run_start;  // of the run that `last` belongs to
  for (int hop = 0; hop < kMaxHops; ++hop) {
    const Tid first = std::max(start, oldest);
    if (first > last) break;  // slots that contradict each other
    const std::int64_t last_ns = probe.time(last);
    if (last_ns <= t_ns) {
      found = {ReadStatus::ok, last, probe.lowest()};
      return found;
    }
    const std::int64_t first_ns = last == first ? last_ns : probe.time(first);
    if (first_ns <= t_ns) {
      found = {ReadStatus::ok, search_run(probe, first, last, first_ns, last_ns, t_ns), kNoTid};
      found.lowest_probed = probe.lowest();
      return found;
    }
    if (first != start ||
        start <= oldest) {  // the run's start, or all before it, has left the ring
      found.lowest_probed = probe.lowest();
      return found;
    }
    // All of this run lies after t. Take the furthest jump that still lies after t, else the
    // parent.
    Tid jump = kNoTid, parent = kNoTid;
    if (!load_field(slots, start, &SlotHeader::run_jump, jump) ||
        !load_field(slots, start, &SlotHeader::run_parent, parent)) {
      found.status = ReadStatus::lapped;
      return found;
    }
    if (jump >= oldest && jump < start && probe.time(jump) > t_ns) {
      start = last = jump;  // only the run's first sample matters: the next round goes on from it
      continue;
    }
    if (parent < oldest || parent >= start) {
      probe.touch(std::min(start, oldest));
      found.lowest_probed = probe.lowest();
      return found;
    }
    last = parent;
    if (!load_field(slots, parent, &SlotHeader::run_start, start)) {
      found.status = ReadStatus::lapped;
      return found;
    }
    if (start > last || start < 0) break;
  }
  found.status = ReadStatus::lapped;
  return found;
}

RunLinks links_for_new_run(const SlotTable& slots, Tid oldest, Tid start, Tid previous_run_start,
                           std::int64_t time_ns) noexcept {
  RunLinks links;
  if (time_ns == INT64_MIN) return links;  // nothing is earlier
  const FoundSample parent =
      find_newest_at_or_before(slots, oldest, start - 1, previous_run_start, time_ns - 1);
  if (parent.status != ReadStatus::ok) return links;
  links.parent = parent.tid;
  links.level = 1;
  // The skew-binary rule: jump over the parent's jump when the two distances ahead are equal, else
  // to the parent. A run whose beginning is gone counts as the root.
  const auto links_of = [&](Tid run, RunLinks& out) noexcept {
    if (run < oldest) return false;
    const SlotHeader& slot = slots.slot(run);
    out = {slot.run_parent.load(std::memory_order_relaxed),
           slot.run_jump.load(std::memory_order_relaxed),
           slot.run_level.load(std::memory_order_relaxed)};
    return true;
  };
  const Tid parent_run = slots.slot(parent.tid).run_start.load(std::memory_order_relaxed);
  links.jump = parent_run;
  RunLinks up, jumped;
  if (!links_of(parent_run, up)) return links;
  links.level = up.level + 1;
  if (up.jump < parent_run && links_of(up.jump, jumped)) {
    RunLinks far;
    const std::int64_t far_level = links_of(jumped.jump, far) ? far.level : 0;
    if (up.level - jumped.level == jumped.level - far_level) links.jump = jumped.jump;
  }
  return links;
}

}  // namespace dssm::ring
