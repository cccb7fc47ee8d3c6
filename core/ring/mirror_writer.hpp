// SPDX-License-Identifier: Apache-2.0
//
// Filling a mirror: a ring that repeats another one, sample by sample, with the same tids. It has
// exactly one writer, its dssmd (or the PConnector that keeps it), so it takes no lock, and a slot
// may stay half filled for as long as the network takes.
#pragma once

#include <dssm/sample.hpp>

#include "core/ring/bell.hpp"
#include "core/ring/sample_publisher.hpp"

namespace dssm::ring {

// The mapping (read-write) and the bell outlive it. One thread.
class MirrorWriter {
 public:
  // Sets right what a dssmd left that died while it filled this ring.
  MirrorWriter(const RingMapping& mapping, Bell& bell) noexcept : publisher_(mapping), bell_(bell) {
    publisher_.recover();
  }

  Tid newest() const noexcept { return publisher_.newest(); }

  // Where the payload of sample `tid` goes; tid > newest(). Then commit(), or begin() again to give
  // this one up: nobody will see it.
  std::byte* begin(Tid tid) noexcept {
    tid_ = tid;
    return publisher_.begin(tid);
  }

  // The payload is in place. When tids were left out before this one, all that was before the gap
  // leaves the ring: as in the owner's, where it is gone too. Sleepers are woken by wake().
  void commit(Time time, Duration clock_error) noexcept {
    publisher_.publish(tid_, time, clock_error);
  }

  // Once after a batch of samples.
  void wake() noexcept { bell_.ring(); }

 private:
  SamplePublisher publisher_;
  Bell& bell_;
  Tid tid_ = kNoTid;
};

}  // namespace dssm::ring
