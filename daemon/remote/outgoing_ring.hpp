// SPDX-License-Identifier: Apache-2.0
//
// The local ring of a remote writer. Programs write to it as to any ring; dssmd publishes their
// samples into the owner's stream. It has no readers, so dssmd keeps the tid of the sample to
// publish next in the header's `first`. So the ring alone, offered back after a crash of dssmd,
// holds where to continue and, by its incarnation, the publisher's number.
//
// The ring begins where the owner's stream is when it is made. So the tid that write() returns is
// the one that the sample gets in the owner's ring, as long as no other program writes to that
// stream and nothing is lost.
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
  // kMinRingBytes: a writer that is faster than the network for a moment loses nothing.
  static constexpr std::uint64_t kMinSlots = 256;
  static constexpr std::uint64_t kMinRingBytes = 4U << 20;

  // A new one for `theirs`, as the owner described it.
  static Result<std::unique_ptr<OutgoingRing>> make(const StreamInfo& theirs,
                                                    MemoryBudgets& budgets,
                                                    const std::string& account = {});
  // One that a program held.
  static Result<std::unique_ptr<OutgoingRing>> open(std::shared_ptr<Stream> stream);
  OutgoingRing(const OutgoingRing&) = delete;
  OutgoingRing& operator=(const OutgoingRing&) = delete;

  const std::shared_ptr<Stream>& stream() const noexcept { return stream_; }
  const ring::RingMapping& mapping() const noexcept { return *mapping_; }
  std::uint64_t publisher() const noexcept { return stream_->incarnation(); }

  // The sample to publish next: at least 0 and at most the one after the newest, whatever programs
  // have written into the header.
  Tid next_untrusted() const noexcept;
  Tid newest_untrusted() const noexcept;
  bool all_published() const noexcept { return next_untrusted() > newest_untrusted(); }

  // Samples up to `last` are in the owner's ring, or lost. An owner may have stored less than is
  // known here: it has another ring now, or 64 other publishers have published into it since.
  //   fails  protocol: that sample was not sent
  Result<void> set_published_untrusted(Tid last);

 private:
  OutgoingRing(std::shared_ptr<Stream> stream, std::shared_ptr<const ring::RingMapping> mapping)
      : stream_(std::move(stream)), mapping_(std::move(mapping)), reader_(*mapping_) {}

  std::shared_ptr<Stream> stream_;
  std::shared_ptr<const ring::RingMapping> mapping_;  // read-write
  ring::RingReader reader_;
};

}  // namespace dssm::daemon
