// SPDX-License-Identifier: Apache-2.0
#include "core/ring/slot_writer.hpp"

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
  copy_in(SlotTable::payload(slots_.slot(tid)), payload.data(), payload.size());
  fence_after_filling(large_);
}

[[gnu::hot]] void SlotWriter::publish(Tid tid, Time time, Duration clock_error) const noexcept {
  SlotHeader& slot = slots_.slot(tid);
  const Tid top = header_->top.load(std::memory_order_relaxed);
  const std::int64_t time_ns = to_ns(time);
  Tid run_start = header_->run_start.load(std::memory_order_relaxed);
  RunLinks links;
  bool starts_run = tid == run_start;
  if (tid != top + 1) {
    // Before top: a reader that sees the new top also sees that no sample before it is valid.
    header_->first.store(tid, std::memory_order_release);
    starts_run = true;
  } else if (tid > header_->first.load(std::memory_order_relaxed) &&
             time_ns < slots_.time_ns(top).load(std::memory_order_relaxed)) {
    links = links_for_new_run(slots_, tid, run_start, time_ns);
    starts_run = true;
  }
  if (starts_run) {
    slot.run_parent.store(links.parent, std::memory_order_release);
    slot.run_jump.store(links.jump, std::memory_order_release);
    slot.run_level.store(links.level, std::memory_order_release);
    run_start = tid;
    // Before top: a reader that sees the new top also sees its run.
    header_->run_start.store(run_start, std::memory_order_release);
  }
  // Release, each: a reader that sees one of these sees the odd sequence too; pairs with the
  // acquire loads of load_info() and load_field().
  slot.tid.store(tid, std::memory_order_release);
  slot.time_ns.store(time_ns, std::memory_order_release);
  slot.clock_error_ns.store(to_ns(clock_error), std::memory_order_release);
  slot.run_start.store(run_start, std::memory_order_release);
  // A search that sees this entry also sees the `top` that moved the entry's previous sample out of
  // the window; pairs with the fence in RingReader::find().
  slots_.time_ns(tid).store(time_ns, std::memory_order_release);
  // Even: the sample is complete. Pairs with the first load of each read.
  slot.sequence.store(published_sequence(tid), std::memory_order_release);
  // Sequentially consistent, like the bell's loads that follow: either a sleeper that has just
  // announced itself sees this top, or the writer sees the announcement.
  header_->top.store(tid, std::memory_order_seq_cst);
}

// With the sample that it did not publish, the dead writer may have begun a run, crossed a gap, or
// advanced a cursor. The slot needs no repair: it is outside of the window, and the next sample
// with that tid overwrites it.
void SlotWriter::recover() const noexcept {
  const Tid top = header_->top.load(std::memory_order_relaxed);
  const Tid run_start = top < 0 ? 0 : slots_.slot(top).run_start.load(std::memory_order_relaxed);
  header_->run_start.store(run_start, std::memory_order_release);
  if (header_->first.load(std::memory_order_relaxed) > top) {
    header_->first.store(top < 0 ? 0 : top, std::memory_order_release);
  }
  PublisherCursors(*header_).recover();
}

[[gnu::hot]] void SlotWriter::prefetch_next(Tid tid) const noexcept {
  SlotHeader& next = slots_.slot(tid + 1);
  __builtin_prefetch(&next, 1);
  __builtin_prefetch(&next + 1, 1);  // the payload's first line
}

}  // namespace dssm::ring
