// SPDX-License-Identifier: Apache-2.0
//
// The ring of a mirror while it is being filled: takes the owner's samples in, knows which one
// comes next, and counts those that never come. Knows no connection and no clock.
//
// Promises to the ring's readers: the window has no holes, tids rise, what was received is visible
// once it is complete, and what was not complete (torn, cut off) never is.
#pragma once

#include <cstddef>
#include <cstdint>
#include <dssm/result.hpp>
#include <memory>
#include <vector>

#include "core/ring/mirror_writer.hpp"
#include "core/ring/ring_reader.hpp"
#include "core/wire/frame_decoder.hpp"
#include "daemon/base/memory_budget.hpp"
#include "daemon/streams/stream.hpp"

namespace dssm::daemon {

class MirrorRing {
 public:
  // Goes on behind what `stream`, a mirror's ring, holds. The budget outlives it.
  static Result<std::unique_ptr<MirrorRing>> open(std::shared_ptr<Stream> stream,
                                                  MemoryBudget& budget);
  MirrorRing(const MirrorRing&) = delete;
  MirrorRing& operator=(const MirrorRing&) = delete;

  const std::shared_ptr<Stream>& stream() const noexcept { return stream_; }

  // The sample to ask the owner for; kNoTid: it never said where this ring begins, so the oldest.
  Tid next() const noexcept { return next_; }

  // The subscription begins with sample `first`.
  //   fails  protocol
  Result<void> on_subscribed_untrusted(Tid first);
  // Where the payload of this sample goes, until end(), or a further begin().
  //   fails  protocol: its tid does not rise
  Result<std::byte*> begin_untrusted(const wire::IncomingSample& sample);
  void end(const wire::IncomingSample& sample, bool torn);
  // The owner's ring no longer has these.
  //   fails  protocol: they were here already
  Result<void> on_gap_untrusted(Tid first, std::uint64_t count);
  // What this PC's readers may make of the samples' times.
  void set_clock(const ring::ClockAssessment& assessment) noexcept {
    mapping_->header().clock.store(assessment);
  }
  // Wakes readers, when anything came since the last time.
  void wake() noexcept;

  Tid newest() const noexcept { return writer_.newest(); }
  std::uint64_t gap_samples() const noexcept { return gap_samples_; }
  std::uint64_t received_samples() const noexcept { return received_samples_; }
  std::uint64_t received_bytes() const noexcept { return received_bytes_; }

 private:
  MirrorRing(std::shared_ptr<Stream> stream, std::shared_ptr<const ring::RingMapping> mapping,
             std::shared_ptr<ring::Bell> bell, MemoryBudget& budget);
  bool would_spoil_window(Tid tid) const noexcept;
  void take_aside(std::size_t bytes);
  void drop_aside() noexcept;

  std::shared_ptr<Stream> stream_;
  std::shared_ptr<const ring::RingMapping> mapping_;
  std::shared_ptr<ring::Bell> bell_;
  MemoryBudget& budget_;
  ring::MirrorWriter writer_;
  ring::RingReader reader_;
  Tid next_;
  bool news_ = false;                   // that sleepers have not been woken for
  std::unique_ptr<std::byte[]> aside_;  // the payload under way, when it must not go to its slot
  MemoryShare aside_share_;
  std::uint64_t gap_samples_ = 0, received_samples_ = 0, received_bytes_ = 0;
};

}  // namespace dssm::daemon
