// SPDX-License-Identifier: Apache-2.0
#include "daemon/remote/outgoing_ring.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <utility>

#include "core/base/try.hpp"
#include "daemon/link/sample_pump.hpp"

namespace dssm::daemon {

Result<std::unique_ptr<OutgoingRing>> OutgoingRing::make(const StreamInfo& theirs,
                                                         MemoryBudgets& budgets,
                                                         const std::string& account) {
  const std::uint64_t small = kMinRingBytes / std::max<std::uint64_t>(theirs.type.payload_bytes, 1);
  std::shared_ptr<Stream> stream =
      DSSM_TRY(Stream::create({.id = theirs.id,
                               .type = theirs.type,
                               .depth = std::max(theirs.depth, std::min(kMinSlots, small)),
                               .cycle = theirs.cycle,
                               .account = account,
                               .purpose = Purpose::remote_writer},
                              budgets));
  std::unique_ptr<OutgoingRing> made = DSSM_TRY(open(std::move(stream)));
  // No program has the ring yet, and those that will get it receive its descriptors through the
  // kernel, which orders these stores before their loads.
  ring::RingHeader& header = made->mapping_->header();
  header.top.store(theirs.newest, std::memory_order_relaxed);
  header.run_start.store(theirs.newest + 1, std::memory_order_relaxed);
  header.first.store(theirs.newest + 1, std::memory_order_relaxed);
  return made;
}

Result<std::unique_ptr<OutgoingRing>> OutgoingRing::open(std::shared_ptr<Stream> stream) {
  auto mapping = DSSM_TRY(stream->map_for_writing());
  return std::unique_ptr<OutgoingRing>(new OutgoingRing(std::move(stream), std::move(mapping)));
}

Tid OutgoingRing::newest_untrusted() const noexcept {
  return std::max(daemon::newest_untrusted(reader_), kNoTid);
}

Tid OutgoingRing::next_untrusted() const noexcept {
  const Tid next = mapping_->header().first.load(std::memory_order_relaxed);
  return std::clamp<Tid>(next, 0, newest_untrusted() + 1);
}

Result<void> OutgoingRing::set_published_untrusted(Tid last) {
  const Tid next = next_untrusted(), newest = newest_untrusted();
  if (last < next) return {};
  if (last > newest) {
    return Error{Errc::protocol,
                 fmt::format("the owner reports sample {} as published, but the samples to publish "
                             "are {} to {}",
                             last, next, newest)};
  }
  mapping_->header().first.store(last + 1, std::memory_order_relaxed);
  return {};
}

}  // namespace dssm::daemon
