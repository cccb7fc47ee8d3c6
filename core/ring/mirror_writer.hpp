// SPDX-License-Identifier: Apache-2.0
//
// Fills a mirror: a ring that repeats another one, sample by sample, with the same tids. This PC's
// dssmd is its only writer, so it takes no lock, and a slot may stay partly filled for as long as
// the network takes.
#pragma once

#include <dssm/sample.hpp>

#include "core/ring/bell.hpp"
#include "core/ring/slot_writer.hpp"

namespace dssm::ring {

// The mapping (read-write) and the bell outlive it. One thread.
class MirrorWriter {
 public:
  // Repairs what a dssmd left that died while it filled this ring.
  MirrorWriter(const RingMapping& mapping, Bell& bell) noexcept : slots_(mapping), bell_(bell) {
    slots_.recover();
  }

  Tid newest() const noexcept { return slots_.newest(); }

  // Where the payload of sample `tid` goes; tid > newest(). Then commit(), or begin() again to
  // discard this one: no reader will see it.
  std::byte* begin(Tid tid) noexcept {
    tid_ = tid;
    return slots_.begin(tid);
  }

  // The payload is in place. When tids were left out before this one, the samples before the gap
  // leave the ring; the owner's ring no longer holds them either. wake() wakes sleepers.
  void commit(Time time, Duration clock_error) noexcept { slots_.publish(tid_, time, clock_error); }

  // Once after a batch of samples.
  void wake() noexcept { bell_.notify(); }

 private:
  SlotWriter slots_;
  Bell& bell_;
  Tid tid_ = kNoTid;
};

}  // namespace dssm::ring
