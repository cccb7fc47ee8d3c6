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

void StatedBounds::add(Time now, Duration bound) {
  constexpr Duration kStep = std::chrono::seconds(1);
  if (stated_.empty() || now - stated_.back().wall >= kStep) {
    if (stated_.empty() || now - stated_.back().wall > kMaxGap) unbroken_from_ = now;
    stated_.push_back({now, bound});
  }
  stated_.back().bound = std::max(stated_.back().bound, bound);
  const Time needed = std::min(unbroken_from_, now - kMinute);
  while (stated_.front().wall < needed) stated_.pop_front();
  if (stated_.size() > kMaxSteps) thin(now);
}

// Joins the two steps before the last minute that are the shortest for their age.
void StatedBounds::thin(Time now) {
  std::size_t shortest = 0;
  double least = 1;
  for (std::size_t i = 0; i + 2 < stated_.size() && stated_[i + 1].wall < now - kMinute; ++i) {
    const auto length = static_cast<double>(to_ns(stated_[i + 2].wall - stated_[i].wall));
    const double part = length / static_cast<double>(to_ns(now - stated_[i].wall));
    if (part < least) least = part, shortest = i;
  }
  StatedBound& joined = stated_[shortest];
  joined.bound = std::max(joined.bound, stated_[shortest + 1].bound);
  stated_.erase(stated_.begin() + static_cast<std::ptrdiff_t>(shortest + 1));
}

PastBounds StatedBounds::past(Duration latest, Time now, Duration limit) const noexcept {
  PastBounds past{latest, now, latest, now};
  Duration of_minute = latest;
  for (auto one = stated_.rbegin(); one != stated_.rend(); ++one) {
    Duration most = std::max(limit, past.greatest);
    if (one->wall < now - kMinute) most = std::min(most, std::max(2 * of_minute, limit / 10));
    if (one->bound > most) break;
    if (one->wall >= now - kMinute) of_minute = std::max(of_minute, one->bound);
    past.greatest = std::max(past.greatest, one->bound);
    past.from = one->wall;
    if (one->wall < now - PastBounds::kRecent) continue;
    past.recent = past.greatest;
    past.recent_from = one->wall;
  }
  return past;
}

}  // namespace dssm::clock
