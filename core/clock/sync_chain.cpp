// SPDX-License-Identifier: Apache-2.0
#include "core/clock/sync_chain.hpp"

#include <algorithm>

namespace dssm::clock {

SyncChain SyncChain::aged(Duration age) const {
  SyncChain later = *this;
  const Duration more = growth(age, ageing);
  for (ClockLink& link : later.chain) link.bound = sum(link.bound, more);
  later.bound = sum(later.bound, more);
  later.root_bound = sum(later.root_bound, more);
  return later;
}

Duration SyncChain::distance_from(const ClockId& clock) const noexcept {
  const auto link = std::find_if(chain.begin(), chain.end(),
                                 [&](const ClockLink& one) { return one.clock == clock; });
  return link == chain.end() ? kUnknownClockError : link->bound;
}

bool share_clock(const SyncChain& one, const SyncChain& other) noexcept {
  return !one.boot_id.empty() && one.boot_id == other.boot_id;
}

Duration distance(const SyncChain& one, const SyncChain& other) noexcept {
  if (share_clock(one, other)) return {};
  Duration shortest = one.root_is_utc && other.root_is_utc ? sum(one.root_bound, other.root_bound)
                                                           : kUnknownClockError;
  for (const ClockLink& link : one.chain) {
    shortest = std::min(shortest, sum(link.bound, other.distance_from(link.clock)));
  }
  return shortest;
}

Duration distance_from_anchor(const SyncChain& writer, const SyncChain& reader) noexcept {
  // By the anchor itself nothing is added to what the reader knows of it.
  const Duration directly = reader.distance_from(writer.anchor);
  // By any other way: from the anchor to the writer's clock, and from there to the reader's.
  const Duration by_writer = sum(writer.distance_from(writer.anchor), distance(writer, reader));
  const bool by_root = writer.bound_is_root && writer.root_is_utc && reader.root_is_utc;
  return std::min({directly, by_writer, by_root ? reader.root_bound : kUnknownClockError});
}

}  // namespace dssm::clock
