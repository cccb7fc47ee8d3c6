// SPDX-License-Identifier: Apache-2.0
//
// How far the clocks of two hosts may be apart. There are two sources of statements, and each is a
// bound that holds by itself: the reports of both hosts, whose sync chains meet in a clock or in
// UTC, and a measurement between the two. FleetClock combines them. docs/clocks.md "Between two
// PCs" and "Measured between two PCs" derive them.
#pragma once

#include <algorithm>
#include <deque>
#include <dssm/time.hpp>
#include <optional>

#include "core/wire/clock_report.hpp"
#include "daemon/clock/pair_measurement.hpp"

namespace dssm::clock {

// How far two clocks may be apart, both reports being of the same moment: 0 for one kernel, else
// the shortest way by a clock that both follow, or by UTC. kUnknownClockError: there is no such
// way.
Duration distance(const wire::ClockReport& one, const wire::ClockReport& other) noexcept;

// How far the time of a sample by `writer`'s clock may be from `reader`'s clock, beyond the
// sample's own clock error (a bound against `writer.anchor`). kUnknownClockError: there is no way.
// Not for clocks that are shared: those have no distance, whatever the clock error.
Duration distance_from_anchor(const wire::ClockReport& writer,
                              const wire::ClockReport& reader) noexcept;

// What was measured: their wall clock minus this one.
struct WallDifference {
  // For so long after it was drawn, a line's beginning counts, too.
  static constexpr Duration kNewLine = std::chrono::seconds(1);

  Duration least{}, greatest{};
  PartsPerBillion ageing = 0;  // by so much may each of the two grow
  // Bound when their line was drawn, if that was within kNewLine: the samples that come after it
  // were stamped before it, and a clock that is slewed was further off then.
  Duration earlier{};

  Duration bound() const noexcept { return std::max({-least, greatest, earlier}); }
  // Whether the clocks cannot be as close as `chain` states.
  bool excludes(Duration chain) const noexcept { return least > chain || -greatest > chain; }
};

// `raws` is the measured difference of the RawClocks at `now`. nullopt: a line is missing or old.
std::optional<WallDifference> wall_difference(const PairMeasurement::Difference& raws,
                                              const ClockLine& theirs, const ClockLine& ours,
                                              const ClockReading& now) noexcept;

// A bound on a distance that was stated from `wall` on, until the next one.
struct StatedBound {
  Time wall;  // the bound holds from here on until the next one
  Duration bound;
};

// Bounds on all that was stated since a time, up to now.
struct PastBounds {
  // Samples of the last seconds count by what was stated in that time.
  static constexpr Duration kRecent = std::chrono::seconds(3);

  Duration greatest{};  // as far back as all of it was within the limit
  Time from;
  Duration recent{};  // the same, for kRecent
  Time recent_from;
};

// The bounds on the distance of two clocks that were stated while they were compared: one for each
// second of the last minute, and one for each longer step before that. Times are by this PC's wall
// clock.
class StatedBounds {
 public:
  static constexpr Duration kMinute = std::chrono::seconds(60);
  // When the clocks were not compared for longer, what was stated before counts for a minute only.
  static constexpr Duration kMaxGap = std::chrono::seconds(5);
  static constexpr std::size_t kMaxSteps = 256;

  void add(Time now, Duration bound);
  void clear() { stated_.clear(); }
  bool empty() const noexcept { return stated_.empty(); }

  // Of the last minute: as far back as all bounds were within the limit. Of the time before: as far
  // back as they were at most twice as great as in that minute, or a tenth of the limit. So a busy
  // hour does not make the bound of the last minute's samples much greater.
  //   latest  the bound at `now`, which may be beyond the limit
  PastBounds past(Duration latest, Time now, Duration limit) const noexcept;

 private:
  void thin(Time now);

  std::deque<StatedBound> stated_;
  Time unbroken_from_{};
};

}  // namespace dssm::clock
