// SPDX-License-Identifier: Apache-2.0
//
// The local ring of a remote writer. Programs write to it as to any ring; dssmd publishes what they
// wrote into the owner's stream. Nobody reads it, so dssmd uses the header's `first` for the sample
// that is to be published next: the ring alone, offered back after a crash of dssmd, says where to
// go on and, by its incarnation, as which publisher.
//
// The ring begins where the owner's stream is at that moment. So the tid that write() returns is
// the one that the sample gets in the owner's ring, as long as nobody else writes to that stream
// and nothing is lost.
#pragma once

#include <cstdint>
#include <dssm/result.hpp>
#include <dssm/sample.hpp>
#include <dssm/stream.hpp>
#include <memory>

#include "core/ring/ring_reader.hpp"
#include "daemon/base/memory_budget.hpp"
#include "daemon/streams/stream.hpp"

namespace dssm::daemon {

class OutgoingRing {
 public:
  // At least this many slots, whatever the owner's ring has, unless they take more than
  // kMinRingBytes: a writer that is faster than the network for a moment shall lose nothing.
  static constexpr std::uint64_t kMinSlots = 256;
  static constexpr std::uint64_t kMinRingBytes = 4U << 20;

  // A new one for `theirs`, as the owner described it.
  static Result<std::unique_ptr<OutgoingRing>> make(const StreamInfo& theirs, MemoryBudget& budget);
  // Goes on with one that a program kept.
  static Result<std::unique_ptr<OutgoingRing>> open(std::shared_ptr<Stream> stream);
  OutgoingRing(const OutgoingRing&) = delete;
  OutgoingRing& operator=(const OutgoingRing&) = delete;

  const std::shared_ptr<Stream>& stream() const noexcept { return stream_; }
  const ring::RingMapping& mapping() const noexcept { return *mapping_; }
  std::uint64_t publisher() const noexcept { return stream_->incarnation(); }

  // The sample to publish next. Programs can write nonsense there; it is at least 0 and at most
  // behind the newest one.
  Tid next_untrusted() const noexcept;
  Tid newest_untrusted() const noexcept;
  bool all_published() const noexcept { return next_untrusted() > newest_untrusted(); }

  // Samples up to `last` are in the owner's ring, or lost. An owner may know of less than we do:
  // its ring is another one by now, or 64 others published into it since.
  //   fails  protocol: that was not sent
  Result<void> note_published_untrusted(Tid last);

 private:
  OutgoingRing(std::shared_ptr<Stream> stream, std::shared_ptr<const ring::RingMapping> mapping)
      : stream_(std::move(stream)), mapping_(std::move(mapping)), reader_(*mapping_) {}

  std::shared_ptr<Stream> stream_;
  std::shared_ptr<const ring::RingMapping> mapping_;  // read-write
  ring::RingReader reader_;
};

}  // namespace dssm::daemon
