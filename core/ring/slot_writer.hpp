// SPDX-License-Identifier: Apache-2.0
//
// Makes the bytes in a slot a sample: writes its stamps, run links, time index, sequence and `top`,
// in the order that readers rely on. RingWriter (programs), MirrorRing (dssmd) and SampleCollector
// (libdssm) are built on it.
#pragma once

#include <dssm/sample.hpp>
#include <span>

#include "core/ring/ring_memory.hpp"

namespace dssm::ring {

// A value; the mapping (read-write) outlives it. Only the ring's current writer may call it: the
// holder of the lock, or the thread that fills a copy of another host's ring.
class SlotWriter {
 public:
  explicit SlotWriter(const RingMapping& mapping) noexcept;

  Tid newest() const noexcept { return header_->top.load(std::memory_order_acquire); }
  RingHeader& header() const noexcept { return *header_; }

  // Marks the slot of sample `tid` as being filled; returns where its payload goes.
  std::byte* begin(Tid tid) const noexcept;

  // Copies the payload of sample `tid` to the place that begin() returned.
  void fill(Tid tid, std::span<const std::byte> payload) const noexcept;

  // The payload is in place: makes it sample `tid`. A tid that does not follow the newest one (in
  // such copies only) leaves a gap, and samples before the gap are no longer readable.
  void publish(Tid tid, Time time, Duration clock_error) const noexcept;

  // Repairs what a writer left that died before it published its sample.
  void recover() const noexcept;

  // Fetches the slot of the sample after `tid` for writing from the caches of the readers that read
  // it one lap ago. Halves the time of a hand-over to a spinning reader.
  void prefetch_next(Tid tid) const noexcept;

 private:
  RingHeader* header_;
  SlotTable slots_;
  bool large_;  // payload so large that memcpy may use non-temporal stores
};

}  // namespace dssm::ring
