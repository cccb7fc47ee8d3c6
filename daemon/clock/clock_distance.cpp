// SPDX-License-Identifier: Apache-2.0
#include "daemon/clock/clock_distance.hpp"

#include <algorithm>
#include <cstdlib>

#include "core/base/time.hpp"

namespace dssm::clock {
namespace {

// Lines that promise less are not worth a statement, and sums with them would overflow.
constexpr Duration kMaxBlur = std::chrono::seconds(1);

}  // namespace

Duration distance(const wire::ClockReport& one, const wire::ClockReport& other) noexcept {
  if (one.shares_clock_with(other)) return {};
  Duration shortest = one.root_is_utc && other.root_is_utc
                          ? sum(one.clock.root_bound, other.clock.root_bound)
                          : kUnknownClockError;
  for (const wire::ClockLink& link : one.chain) {
    shortest = std::min(shortest, sum(link.bound, other.distance_from(link.host)));
  }
  return shortest;
}

Duration distance_from_anchor(const wire::ClockReport& writer,
                              const wire::ClockReport& reader) noexcept {
  // By the anchor itself: nothing is added to what the reader knows of it.
  const Duration by_anchor = reader.distance_from(writer.anchor);
  // By any other way: from the anchor to the writer's clock, and from there to the reader's.
  const Duration by_writer = sum(writer.distance_from(writer.anchor), distance(writer, reader));
  const bool by_root = writer.bound_is_root && writer.root_is_utc && reader.root_is_utc;
  return std::min({by_anchor, by_writer, by_root ? reader.clock.root_bound : kUnknownClockError});
}

std::optional<WallDifference> wall_difference(const PairMeasurement::Difference& raws,
                                              const ClockLine& theirs, const ClockLine& ours,
                                              const ClockReading& now) noexcept {
  const std::optional<Time> least = theirs.at(now.raw + raws.least);
  const std::optional<Time> greatest = theirs.at(now.raw + raws.greatest);
  if (!least || !greatest || !ours.exists()) return std::nullopt;
  const Duration blur = sum(theirs.tolerance, now.blur);
  // The rates of the lines differ by what the daemons of the clocks correct and slew.
  const PartsPerBillion corrected = theirs.rate - ours.rate;
  if (blur > kMaxBlur) return std::nullopt;
  WallDifference found{
      *least - now.wall - blur,
      *greatest - now.wall + blur,
      std::max(std::abs(corrected + raws.slowest), std::abs(corrected + raws.fastest)),
      {}};
  const Duration age = now.raw + raws.greatest - theirs.raw;
  if (age > Duration::zero() && age <= WallDifference::kNewLine) {
    const Duration lost = gained(age, corrected + raws.fastest);
    const Duration won = gained(age, corrected + raws.slowest);
    found.earlier = std::max(lost - found.least, found.greatest - won);
  }
  return found;
}

PastBounds past_bounds(const std::deque<StatedBound>& stated, Duration latest, Time now,
                       Duration limit) noexcept {
  PastBounds past{latest, now, latest, now};
  for (auto one = stated.rbegin(); one != stated.rend(); ++one) {
    if (one->bound > std::max(limit, past.greatest)) break;
    past.greatest = std::max(past.greatest, one->bound);
    past.from = one->wall;
    if (one->wall < now - PastBounds::kRecent) continue;
    past.recent = past.greatest;
    past.recent_from = one->wall;
  }
  return past;
}

}  // namespace dssm::clock
