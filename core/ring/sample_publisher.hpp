// SPDX-License-Identifier: Apache-2.0
//
// What makes the bytes in a slot a sample: stamps, run links, time index, sequence, top. Shared by
// the writers of a stream and by dssmd, which fills mirrors.
#pragma once

#include <dssm/sample.hpp>
#include <span>

#include "core/ring/ring_memory.hpp"
#include "core/ring/slot_table.hpp"

namespace dssm::ring {

// A value; the mapping (read-write) outlives it. Only whoever is the ring's writer at the moment
// calls it: the holder of the lock, or the dssmd of a mirror.
class SamplePublisher {
 public:
  explicit SamplePublisher(const RingMapping& mapping) noexcept;

  Tid newest() const noexcept { return header_->top.load(std::memory_order_acquire); }
  RingHeader& header() const noexcept { return *header_; }

  // Marks the slot of sample `tid` as being filled; returns where its payload goes.
  std::byte* begin(Tid tid) const noexcept;

  // Copies the payload of sample `tid`, which begin() gave the place of.
  void fill(Tid tid, std::span<const std::byte> payload) const noexcept;

  // The payload is in place: makes it sample `tid`. A tid that does not follow the newest one (in
  // mirrors only) leaves a gap, and what was before it is not readable any more.
  void publish(Tid tid, Time time, Duration clock_error) const noexcept;

  // Sets right what a writer left that died before its sample was there.
  void recover() const noexcept;

  // Takes the line of the sample after `tid` away from the readers of the last lap, so that the
  // next write does not wait for it. Halves the time of a hand-over to a spinning reader.
  void expect_next(Tid tid) const noexcept;

 private:
  RingHeader* header_;
  SlotTable slots_;
  bool large_;  // payload so large that memcpy may use non-temporal stores
};

}  // namespace dssm::ring
