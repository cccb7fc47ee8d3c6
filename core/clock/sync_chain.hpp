// SPDX-License-Identifier: Apache-2.0
//
// Where a PC's clock stands in the fleet, as the PC itself says: how far it may be from each of the
// clocks that it follows, directly or through others. From two of these follows how far two clocks
// may be apart. docs/clocks.md "Between two PCs" derives it.
#pragma once

#include <array>
#include <cstdint>
#include <dssm/time.hpp>
#include <string>
#include <vector>

#include "core/clock/clock_bound.hpp"

namespace dssm::clock {

// The dssmd whose clock it is: its host id.
using ClockId = std::array<std::uint8_t, 16>;

struct ClockLink {
  ClockId clock{};
  Duration bound = kUnknownClockError;  // >= 0: from the time that this clock's chronyd keeps

  friend bool operator==(const ClockLink& a, const ClockLink& b) = default;
};

struct SyncChain {
  // A chain that is longer than this has a loop.
  static constexpr std::size_t kMostLinks = 8;

  std::string boot_id;           // empty: not known
  std::vector<ClockLink> chain;  // this clock itself, whom it follows, whom that one follows ...
  // Which link of the chain samples are stamped against, and by how much at this moment.
  ClockId anchor{};
  Duration bound = kUnknownClockError;
  bool bound_is_root = false;  // they are stamped with root_bound, for want of a fleet to follow
  Duration root_bound = kUnknownClockError;  // from UTC, if that is where the root has its time
  bool root_is_utc = false;                  // false: the root is a PC that follows nobody
  PartsPerBillion ageing = 0;                // of all bounds here

  friend bool operator==(const SyncChain& a, const SyncChain& b) = default;

  // As it is `age` later, when nothing more was heard.
  SyncChain aged(Duration age) const;
  // kUnknownClockError: it is not in the chain.
  Duration distance_from(const ClockId& clock) const noexcept;
};

// Whether both have the same kernel, and so the same clock.
bool share_clock(const SyncChain& one, const SyncChain& other) noexcept;

// How far two clocks may be apart at this moment: 0 for one kernel, else the shortest way by a
// clock that both follow, or by UTC. kUnknownClockError: there is no such way.
Duration distance(const SyncChain& one, const SyncChain& other) noexcept;

// How far the time of a sample by `writer`'s clock may be from `reader`'s clock, beyond what the
// sample itself is stamped with (a bound against `writer.anchor`). kUnknownClockError: there is no
// way. Not for clocks that share one: those have no distance, whatever is stamped.
Duration distance_from_anchor(const SyncChain& writer, const SyncChain& reader) noexcept;

}  // namespace dssm::clock
