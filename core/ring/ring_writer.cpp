// SPDX-License-Identifier: Apache-2.0
#include "core/ring/ring_writer.hpp"

#include <unistd.h>

#include <algorithm>
#include <array>

#include "core/ring/copy.hpp"
#include "core/ring/robust_lock.hpp"
#include "core/ring/time_search.hpp"

namespace dssm::ring {
namespace {

// The rings whose slots this thread has on loan: taking such a lock again would wait for ever.
struct HeldRings {
  std::array<const RingHeader*, 8> rings{};
  std::size_t count = 0;

  bool holds(const RingHeader* ring) const noexcept {
    return std::find(rings.begin(), rings.begin() + count, ring) != rings.begin() + count;
  }
  void add(const RingHeader* ring) noexcept { rings[count++] = ring; }
  void remove(const RingHeader* ring) noexcept {
    std::remove(rings.begin(), rings.begin() + count, ring);
    --count;
  }
};
// Initial-exec: one load instead of a call, on the path of every write. It takes 72 bytes of the
// room that the C library keeps for libraries that are loaded late.
[[gnu::tls_model("initial-exec")]] thread_local constinit HeldRings held_rings;

}  // namespace

RingWriter::RingWriter(const RingMapping& mapping, Bell& bell, int doorbell) noexcept
    : header_(&mapping.header()),
      slots_(mapping),
      bell_(&bell),
      doorbell_(doorbell),
      large_(mapping.geometry().payload_bytes >= kLargeBytes) {}

bool RingWriter::lock() noexcept {
  if (held_rings.count != 0 && held_rings.holds(header_)) return false;
  switch (lock_robust(header_->lock)) {
    case LockResult::locked:
      return true;
    case LockResult::recovered:
      recover();
      return true;
    case LockResult::refused:
      return false;
  }
  return false;
}

void RingWriter::unlock() noexcept { pthread_mutex_unlock(&header_->lock); }

// The dead writer may have begun a run with the sample that it did not finish. Its slot needs no
// repair: the next sample takes the same tid.
void RingWriter::recover() noexcept {
  const Tid top = header_->top.load(std::memory_order_relaxed);
  const Tid run_start = top < 0 ? 0 : slots_.slot(top).run_start.load(std::memory_order_relaxed);
  header_->run_start.store(run_start, std::memory_order_release);
}

std::byte* RingWriter::begin() noexcept {
  if (held_rings.count == held_rings.rings.size() || !lock()) return nullptr;
  held_rings.add(header_);
  const Tid tid = header_->top.load(std::memory_order_relaxed) + 1;
  SlotHeader& slot = slots_.slot(tid);
  slot.sequence.store(published_sequence(tid) - 1, std::memory_order_relaxed);
  fence_before_filling(large_);
  return SlotTable::payload(slot);
}

void RingWriter::cancel() noexcept {
  // The slot keeps its odd sequence: it was outside the readable window already.
  held_rings.remove(header_);
  unlock();
}

Tid RingWriter::commit(Time time, Duration clock_error) noexcept {
  // No fence: glibc's memcpy ends its non-temporal stores with one, and who uses such stores
  // directly has to, as before any other publication.
  const Tid tid = publish(time, clock_error);
  held_rings.remove(header_);
  unlock();
  follow_up(tid);
  return tid;
}

Tid RingWriter::write(std::span<const std::byte> payload, Time time,
                      Duration clock_error) noexcept {
  if (!lock()) return kNoTid;
  const Tid tid = header_->top.load(std::memory_order_relaxed) + 1;
  SlotHeader& slot = slots_.slot(tid);
  // Odd: readers turn away. The fence keeps every byte of the payload behind it.
  slot.sequence.store(published_sequence(tid) - 1, std::memory_order_relaxed);
  fence_before_filling(large_);
  copy_in(SlotTable::payload(slot), payload.data(), payload.size());
  fence_after_filling(large_);
  publish(time, clock_error);
  unlock();
  follow_up(tid);
  return tid;
}

// The payload is in place; stamps, index, sequence and top make it a sample.
Tid RingWriter::publish(Time time, Duration clock_error) noexcept {
  const Tid tid = header_->top.load(std::memory_order_relaxed) + 1;
  SlotHeader& slot = slots_.slot(tid);
  const std::int64_t time_ns = to_ns(time);
  Tid run_start = header_->run_start.load(std::memory_order_relaxed);
  if (tid > 0 && time_ns < slots_.time_ns(tid - 1).load(std::memory_order_relaxed)) {
    const RunLinks links = links_for_new_run(slots_, tid, run_start, time_ns);
    slot.run_parent.store(links.parent, std::memory_order_release);
    slot.run_jump.store(links.jump, std::memory_order_release);
    slot.run_level.store(links.level, std::memory_order_release);
    run_start = tid;
    // Before top: whoever sees the new top sees its run.
    header_->run_start.store(run_start, std::memory_order_release);
  } else if (tid == run_start) {
    slot.run_parent.store(kNoTid, std::memory_order_release);
    slot.run_jump.store(kNoTid, std::memory_order_release);
    slot.run_level.store(0, std::memory_order_release);
  }
  // Release, each: a reader that sees one of these sees the odd sequence too; pairs with the
  // acquire loads of load_info() and load_field().
  slot.tid.store(tid, std::memory_order_release);
  slot.time_ns.store(time_ns, std::memory_order_release);
  slot.clock_error_ns.store(to_ns(clock_error), std::memory_order_release);
  slot.run_start.store(run_start, std::memory_order_release);
  // A search that sees this entry sees the top that put its old meaning out of the window; pairs
  // with the fence in RingReader::find().
  slots_.time_ns(tid).store(time_ns, std::memory_order_release);
  // Even: the sample is whole. Pairs with the first load of each read.
  slot.sequence.store(published_sequence(tid), std::memory_order_release);
  // Sequentially consistent, as are the bell's loads in follow_up(): either a sleeper that just
  // announced itself sees this top, or we see the announcement.
  header_->top.store(tid, std::memory_order_seq_cst);
  return tid;
}

// What follows a sample, outside of the lock: waking who sleeps, and getting ready for the next
// one.
void RingWriter::follow_up(Tid tid) noexcept {
  bell_->ring();
  if (doorbell_ >= 0 && bell_->doorbell_armed()) {
    const std::uint64_t one = 1;
    // Non-blocking: a counter that is full has been rung enough.
    [[maybe_unused]] const ssize_t written = ::write(doorbell_, &one, sizeof one);
  }
  // Readers of the last lap have the next slot in their caches: take it away from them now, so that
  // the next write does not wait for it. Halves the time of a hand-over to a spinning reader.
  SlotHeader& next = slots_.slot(tid + 1);
  __builtin_prefetch(&next, 1);
  __builtin_prefetch(&next + 1, 1);  // the payload's first line
}

}  // namespace dssm::ring
