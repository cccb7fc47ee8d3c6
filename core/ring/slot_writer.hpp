// SPDX-License-Identifier: Apache-2.0
//
// Makes the bytes in a slot a sample: writes its stamps, run links, time index, sequence and `top`,
// in the order that readers rely on. RingWriter (programs), MirrorRing (dssmd) and SampleCollector
// (libdssm) are built on it.
#pragma once

#include <atomic>
#include <dssm/sample.hpp>
#include <span>

#include "core/ring/ring_memory.hpp"

namespace dssm::ring {

struct RunLinks;

// A value; the mapping (read-write) outlives it. Only the ring's current writer may call it: the
// holder of the lock, or the thread that fills a copy of another host's ring.
class SlotWriter {
 public:
  explicit SlotWriter(const RingMapping& mapping) noexcept;

  Tid newest() const noexcept { return header_->top.load(std::memory_order_acquire); }
  RingHeader& header() const noexcept { return *header_; }

  // Marks the slot of sample `tid` as being filled; returns where its payload goes.
  std::byte* begin(Tid tid) const noexcept;

  // Copies the payload of sample `tid`, at most payload_bytes of the stream, to the place that
  // begin() returned.
  void fill(Tid tid, std::span<const std::byte> payload) const noexcept;

  // The payload is in place: makes it sample `info.tid`. A tid that does not follow the newest one
  // (in such copies only) leaves a gap, and samples before the gap are no longer readable; unless
  // lose_before_next() or skip_to() came before.
  void publish(const SampleInfo& info) const noexcept {
    finish(info.tid, info.time, info.clock_error, info.payload_bytes);
    // Sequentially consistent, like the bell's loads that follow: either a sleeper that has just
    // announced itself sees this top, or the writer sees the announcement.
    header_->top.store(info.tid, std::memory_order_seq_cst);
  }

  // The same for the holder of the lock, who unlocks before those loads (RobustLock::unlock()).
  // That is an atomic exchange: on x86-64 a full barrier, so one of the store's own, which takes
  // another 5 ns, is not needed. On AArch64 it is not a full barrier, but a sequentially consistent
  // store takes no longer than a release store there.
  void publish_before_unlock(const SampleInfo& info) const noexcept {
#ifdef __x86_64__
    constexpr auto kOrder = std::memory_order_release;
#else
    constexpr auto kOrder = std::memory_order_seq_cst;
#endif
    finish(info.tid, info.time, info.clock_error, info.payload_bytes);
    header_->top.store(info.tid, kOrder);
  }

  // In mirrors: samples that are lost, or come later than newer ones. docs/ring-layout.md "Hole".

  // Sample `tid` is the next one to be published: those that then leave the window leave it now, so
  // that their slots can be written. Needed before begin() if it does not follow on the newest one.
  void make_room(Tid tid) const noexcept;
  // Sample `tid`, of that time, is the next one to be published; those between the newest one and
  // it will never come.
  void lose_before_next(Tid tid, Time time) const noexcept;
  // Sample `tid` is the next one to be published; samples [from, tid) belong to the hole, until
  // they come or are lost.
  //   from  newest() + 1; in an empty ring any: none before it is readable
  void skip_to(Tid tid, Tid from) const noexcept;
  // The payload is in place: makes it sample `info.tid`, which is in the hole.
  void publish_in_hole(const SampleInfo& info) const noexcept;
  // Those of samples [first, end) that are in the hole and not here will never come.
  void lose_in_hole(Tid first, Tid end) const noexcept;
  // After recover(): samples that were lost with one that was not published may come now.
  void unmark_lost() const noexcept;
  // The hole ends where its last samples begin that are here or lost.
  void shrink_hole() const noexcept;

  // Repairs what a writer left that died before it published its sample.
  void recover() const noexcept;

  // Fetches the slot of the sample after `tid` for writing from the caches of the readers that read
  // it one lap ago. Halves the time of a hand-over to a spinning reader.
  void prefetch_next(Tid tid) const noexcept;

 private:
  // All but `top`. Each by itself, because that way they stay in registers: 2 ns of each write.
  void finish(Tid tid, Time time, Duration clock_error, std::uint64_t bytes) const noexcept;
  void store(const SampleInfo& info, Tid run_start) const noexcept;
  void begin_run(Tid tid, const RunLinks& links) const noexcept;
  Tid link(Tid tid, Tid previous_run) const noexcept;
  void join(Tid begin, Tid end, bool is_continued) const noexcept;
  void continue_run(Tid begin, Tid end, Tid run) const noexcept;
  bool continues_after_lost(Tid tid) const noexcept;
  bool is_here(Tid tid) const noexcept;
  bool is_lost(Tid tid) const noexcept;

  RingHeader* header_;
  SlotTable slots_;
  bool large_;  // payload so large that memcpy may use non-temporal stores
};

}  // namespace dssm::ring
