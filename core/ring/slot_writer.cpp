// SPDX-License-Identifier: Apache-2.0
#include "core/ring/slot_writer.hpp"

#include <algorithm>

#include "core/ring/copy.hpp"
#include "core/ring/publisher_cursors.hpp"
#include "core/ring/time_search.hpp"

namespace dssm::ring {

SlotWriter::SlotWriter(const RingMapping& mapping) noexcept
    : header_(&mapping.header()),
      slots_(mapping),
      large_(mapping.geometry().payload_bytes >= kLargeBytes) {}

[[gnu::hot]] std::byte* SlotWriter::begin(Tid tid) const noexcept {
  SlotHeader& slot = slots_.slot(tid);
  // Odd: readers reject the slot. The fence orders this store before every byte of the payload.
  slot.sequence.store(published_sequence(tid) - 1, std::memory_order_relaxed);
  fence_before_filling(large_);
  return SlotTable::payload(slot);
}

[[gnu::hot]] void SlotWriter::fill(Tid tid, std::span<const std::byte> payload) const noexcept {
  if (!payload.empty()) {
    copy_in(SlotTable::payload(slots_.slot(tid)), payload.data(), payload.size());
  }
  fence_after_filling(large_);
}

[[gnu::hot]] void SlotWriter::finish(Tid tid, Time time, Duration clock_error,
                                     std::uint64_t bytes) const noexcept {
  const Tid top = header_->top.load(std::memory_order_relaxed);
  const std::int64_t time_ns = to_ns(time);
  Tid run_start = header_->run_start.load(std::memory_order_relaxed);
  RunLinks links;
  bool starts_run = tid == run_start;
  if (tid != top + 1) {
    starts_run = !continues_after_lost(tid);
  } else if (tid > header_->first.load(std::memory_order_relaxed) &&
             time_ns < slots_.time_ns(top).load(std::memory_order_relaxed)) {
    links = links_for_new_run(slots_, slots_.oldest_for(top), tid, run_start, time_ns);
    starts_run = true;
  }
  if (starts_run) {
    begin_run(tid, links);
    run_start = tid;
    // Before top: a reader that sees the new top also sees its run.
    header_->run_start.store(run_start, std::memory_order_release);
  }
  store({tid, time, clock_error, bytes}, run_start);
  // Even: the sample is complete. Pairs with the first load of each read.
  slots_.slot(tid).sequence.store(published_sequence(tid), std::memory_order_release);
}

[[gnu::always_inline]] inline void SlotWriter::store(const SampleInfo& info,
                                                     Tid run_start) const noexcept {
  SlotHeader& slot = slots_.slot(info.tid);
  const std::int64_t time_ns = to_ns(info.time);
  // Release, each: a reader that sees one of these sees the odd sequence too; pairs with the
  // acquire loads of load_info() and load_field().
  slot.payload_bytes.store(info.payload_bytes, std::memory_order_release);
  slot.time_ns.store(time_ns, std::memory_order_release);
  slot.clock_error_ns.store(to_ns(info.clock_error), std::memory_order_release);
  slot.run_start.store(run_start, std::memory_order_release);
  // A search that sees this entry also sees the `top` that moved the entry's previous sample out of
  // the window; pairs with the fence in RingReader::find().
  slots_.time_ns(info.tid).store(time_ns, std::memory_order_release);
}

void SlotWriter::begin_run(Tid tid, const RunLinks& links) const noexcept {
  SlotHeader& slot = slots_.slot(tid);
  slot.run_parent.store(links.parent, std::memory_order_release);
  slot.run_jump.store(links.jump, std::memory_order_release);
  slot.run_level.store(links.level, std::memory_order_release);
}

// --- mirrors: samples that are lost, and those that come late

// Whether lose_before_next() made `tid` the next sample. Otherwise, and unless skip_to() did, none
// before it stays readable.
[[gnu::cold]] bool SlotWriter::continues_after_lost(Tid tid) const noexcept {
  if (tid > 0 && is_lost(tid - 1)) return true;
  // Before top: a reader that sees the new top also sees that no sample before it is valid.
  if (tid != header_->hole_end.load(std::memory_order_relaxed)) {
    header_->first.store(tid, std::memory_order_release);
  }
  return false;
}

// Before the slots and the times of samples that leave the window: see RingReader::find().
void SlotWriter::make_room(Tid tid) const noexcept {
  const Tid oldest = tid - static_cast<Tid>(slots_.depth()) + 2;  // when `tid` is the newest
  if (oldest <= header_->first.load(std::memory_order_relaxed)) return;
  header_->first.store(oldest, std::memory_order_release);
}

void SlotWriter::lose_before_next(Tid tid, Time time) const noexcept {
  const Tid top = newest();
  if (top < 0 || tid - top >= static_cast<Tid>(slots_.depth()) - 1) return;  // none stays
  make_room(tid);
  Tid run = header_->run_start.load(std::memory_order_relaxed);
  const std::int64_t time_ns = to_ns(time);
  if (time_ns < slots_.time_ns(top).load(std::memory_order_relaxed)) {
    const RunLinks links = links_for_new_run(slots_, slots_.oldest_for(top), top + 1, run, time_ns);
    run = top + 1;
    begin(run);
    begin_run(run, links);
    header_->run_start.store(run, std::memory_order_release);
  }
  for (Tid lost = top + 1; lost < tid; ++lost) {
    begin(lost);
    store({lost, time, kUnknownClockError, 0}, run);
    slots_.slot(lost).sequence.store(lost_sequence(lost), std::memory_order_release);
  }
}

bool SlotWriter::is_here(Tid tid) const noexcept {
  return slots_.slot(tid).sequence.load(std::memory_order_relaxed) == published_sequence(tid);
}

bool SlotWriter::is_lost(Tid tid) const noexcept {
  return slots_.slot(tid).sequence.load(std::memory_order_relaxed) == lost_sequence(tid);
}

// The end first, and both before the `top` that makes the hole: see hole_of().
void SlotWriter::skip_to(Tid tid, Tid from) const noexcept {
  const TidRange hole = hole_of(*header_);
  const bool grows = !hole.is_empty() && hole.end > slots_.oldest_for(newest());
  const Tid begin = grows ? hole.begin : from;
  if (newest() < 0) header_->first.store(from, std::memory_order_release);
  make_room(tid);
  header_->hole_end.store(tid, std::memory_order_release);
  header_->hole_begin.store(begin, std::memory_order_release);
}

// No search looks at it before shrink_hole().
void SlotWriter::publish_in_hole(const SampleInfo& info) const noexcept {
  store(info, info.tid);
  slots_.slot(info.tid).sequence.store(published_sequence(info.tid), std::memory_order_release);
}

void SlotWriter::lose_in_hole(Tid first, Tid end) const noexcept {
  const TidRange hole = hole_of(*header_);
  Tid tid = std::max({first, hole.begin, slots_.oldest_for(newest())});
  for (const Tid last = std::min(end, hole.end); tid < last; ++tid) {
    if (!is_here(tid)) {
      slots_.slot(tid).sequence.store(lost_sequence(tid), std::memory_order_release);
    }
  }
}

void SlotWriter::shrink_hole() const noexcept {
  const TidRange hole = hole_of(*header_);
  if (hole.is_empty()) return;
  const Tid top = newest();
  const Tid oldest = slots_.oldest_for(top);
  const Tid lowest = std::max(hole.begin, oldest);
  Tid begin = hole.end;
  while (begin > lowest && (is_here(begin - 1) || is_lost(begin - 1))) --begin;
  const bool closes = begin <= lowest;
  const Tid found = hole.end - begin;
  const bool is_one_run = header_->run_start.load(std::memory_order_relaxed) == hole.end;
  // To link all samples after the hole again takes time for each of them.
  if (!closes && (found == 0 || (!is_one_run && found < (top - hole.end) / 2))) return;
  if (found > 0) join(begin, hole.end, closes && begin == hole.begin && begin > oldest);
  header_->hole_end.store(closes ? hole.begin : begin, std::memory_order_release);
}

// Links samples [begin, end), and those from `end` on with them. What the links said before is
// still true while a reader sees some of them: they only said of fewer samples where to search.
//   is_continued  the samples before `begin` are linked
void SlotWriter::join(Tid begin, Tid end, bool is_continued) const noexcept {
  for (Tid tid = end - 1; tid >= begin; --tid) {
    if (is_here(tid)) continue;
    slots_.time_ns(tid).store(slots_.time_ns(tid + 1).load(std::memory_order_relaxed),
                              std::memory_order_release);
  }
  Tid run = begin, tid = begin;
  if (is_continued) {
    run = slots_.slot(begin - 1).run_start.load(std::memory_order_relaxed);
  } else {
    begin_run(begin, {});
    slots_.slot(begin).run_start.store(begin, std::memory_order_release);
    ++tid;
  }
  for (; tid < end; ++tid) run = link(tid, run);
  if (header_->run_start.load(std::memory_order_relaxed) != end) {
    for (const Tid top = newest(); tid <= top; ++tid) run = link(tid, run);
  } else if (link(end, run) == end) {
    return;  // its time runs backwards: it still begins the newest run
  } else {
    continue_run(begin, end, run);
  }
  header_->run_start.store(run, std::memory_order_release);
}

// All samples from `end` on are of the run that begins at `run`, and their slots name `end`, or
// what this function left. Samples between a start that is named and the run's are found by its
// parent, the sample before it. To name the run's start in all of them each time would take too
// long; these ranges are put together when they are not much longer than what is new, [begin, end):
// then searches pass O(log depth) of them, and each sample is written as often.
void SlotWriter::continue_run(Tid begin, Tid end, Tid run) const noexcept {
  const Tid top = newest();
  const auto named = [&](Tid tid) {
    return slots_.slot(tid).run_start.load(std::memory_order_relaxed);
  };
  begin_run(end, {end - 1, kNoTid, 0});
  slots_.slot(end).run_start.store(end, std::memory_order_release);
  for (Tid range = end; range <= top && named(range) == range;) {
    const Tid limit = std::min(top + 1, range + 2 * (range - begin));
    Tid after = range + 1;
    while (after < limit && named(after) == range) ++after;
    if (after == limit && after <= top && named(after) == range) return;  // it is long
    for (Tid tid = range; tid < after; ++tid) {
      slots_.slot(tid).run_start.store(run, std::memory_order_release);
    }
    range = after;
  }
}

// The run of sample `tid - 1` begins at `run`; returns where that of `tid` does.
Tid SlotWriter::link(Tid tid, Tid run) const noexcept {
  const std::int64_t time_ns = slots_.time_ns(tid).load(std::memory_order_relaxed);
  if (time_ns < slots_.time_ns(tid - 1).load(std::memory_order_relaxed)) {
    begin_run(tid, links_for_new_run(slots_, slots_.oldest_for(newest()), tid, run, time_ns));
    run = tid;
  }
  slots_.slot(tid).run_start.store(run, std::memory_order_release);
  return run;
}

// With the sample that it did not publish, the dead writer may have begun a run, crossed a gap, or
// advanced a cursor. Of a hole that it was making greater the end is not known: samples before the
// newest that are here become searchable with the next shrink_hole(). The slot needs no repair: it
// is outside of the window, and the next sample with that tid overwrites it.
void SlotWriter::recover() const noexcept {
  const Tid top = header_->top.load(std::memory_order_relaxed);
  const Tid run_start = top < 0 ? 0 : slots_.slot(top).run_start.load(std::memory_order_relaxed);
  header_->run_start.store(run_start, std::memory_order_release);
  if (header_->first.load(std::memory_order_relaxed) > top) {
    header_->first.store(top < 0 ? 0 : top, std::memory_order_release);
  }
  if (header_->hole_end.load(std::memory_order_relaxed) > top) {
    header_->hole_end.store(std::max<Tid>(top, 0), std::memory_order_release);
  }
  PublisherCursors(*header_).recover();
}

void SlotWriter::unmark_lost() const noexcept {
  for (Tid tid = newest() + 1; is_lost(tid); ++tid) begin(tid);
}

[[gnu::hot]] void SlotWriter::prefetch_next(Tid tid) const noexcept {
  SlotHeader& next = slots_.slot(tid + 1);
  __builtin_prefetch(&next, 1);
  __builtin_prefetch(&next + 1, 1);  // the payload's first line
}

}  // namespace dssm::ring
