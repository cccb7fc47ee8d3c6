// SPDX-License-Identifier: Apache-2.0
#include "daemon/remote/outgoing_ring.hpp"

#include <algorithm>
#include <string>
#include <utility>

#include "daemon/link/sample_pump.hpp"

namespace dssm::daemon {

Result<std::unique_ptr<OutgoingRing>> OutgoingRing::make(const StreamInfo& theirs,
                                                         MemoryBudget& budget) {
  const std::uint64_t small = kMinRingBytes / std::max<std::uint64_t>(theirs.type.payload_bytes, 1);
  Result<std::shared_ptr<Stream>> stream =
      Stream::create({.id = theirs.id,
                      .type = theirs.type,
                      .depth = std::max(theirs.depth, std::min(kMinSlots, small)),
                      .cycle = theirs.cycle,
                      .purpose = Purpose::remote_writer},
                     budget);
  if (!stream) return std::move(stream).error();
  Result<std::unique_ptr<OutgoingRing>> made = open(*std::move(stream));
  if (!made) return made;
  // Nobody has seen the ring yet. An order is needed all the same by those who come to see it: the
  // descriptors pass through the kernel.
  ring::RingHeader& header = (*made)->mapping_->header();
  header.top.store(theirs.newest, std::memory_order_relaxed);
  header.run_start.store(theirs.newest + 1, std::memory_order_relaxed);
  header.first.store(theirs.newest + 1, std::memory_order_relaxed);
  return made;
}

Result<std::unique_ptr<OutgoingRing>> OutgoingRing::open(std::shared_ptr<Stream> stream) {
  auto mapping = stream->map_for_writing();
  if (!mapping) return std::move(mapping).error();
  return std::unique_ptr<OutgoingRing>(new OutgoingRing(std::move(stream), *std::move(mapping)));
}

Tid OutgoingRing::newest_untrusted() const noexcept {
  return std::max(daemon::newest_untrusted(reader_), kNoTid);
}

Tid OutgoingRing::next_untrusted() const noexcept {
  const Tid next = mapping_->header().first.load(std::memory_order_relaxed);
  return std::clamp<Tid>(next, 0, newest_untrusted() + 1);
}

Result<void> OutgoingRing::note_published_untrusted(Tid last) {
  const Tid next = next_untrusted(), newest = newest_untrusted();
  if (last < next) return {};
  if (last > newest) {
    return Error{Errc::protocol, "it says that our sample " + std::to_string(last) +
                                     " is written, and ours to be published are " +
                                     std::to_string(next) + " to " + std::to_string(newest)};
  }
  mapping_->header().first.store(last + 1, std::memory_order_relaxed);
  return {};
}

}  // namespace dssm::daemon
