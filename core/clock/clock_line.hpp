// SPDX-License-Identifier: Apache-2.0
//
// A PC's wall clock as a line over its RawClock. While no program sets or slews the wall clock
// anew, the line says what it shows; dssmd tells other hosts a new line as soon as the wall clock
// has left the old one. So they know that clock at each moment, and not only when they asked.
// docs/clocks.md "Measured between two PCs".
#pragma once

#include <dssm/time.hpp>
#include <optional>

#include "core/base/time.hpp"
#include "core/clock/clock_bound.hpp"

namespace dssm::clock {

// Both clocks at one moment.
struct ClockReading {
  RawTime raw{};
  Time wall{};
  Duration blur{};  // the wall clock showed `wall` when the RawClock was at most so far from `raw`

  // Reads both, several times until they are close together.
  static ClockReading now() noexcept;
};

struct ClockLine {
  // Beyond this the wall clock has left the line. On top comes what reading two clocks takes.
  static constexpr Duration kMaxOff = std::chrono::microseconds(4);
  // A line that is older is not used: dssmd draws a new one much earlier.
  static constexpr Duration kMaxAge = std::chrono::hours(1);
  // Faster or slower than this no program can make the wall clock (adjtimex(2): a tenth).
  static constexpr PartsPerBillion kMaxRate = 200'000'000;
  // A rate is computed only from two readings whose distance is so many times the sum of their
  // `blur`, so that it is wrong by 1000 ppm at most. The error grows with time, until there is
  // another line.
  static constexpr int kExactness = 1000;

  RawTime raw{};             // where the line begins; zero: there is none
  Time wall{};               // what the wall clock showed there
  PartsPerBillion rate = 0;  // the wall clock gains so much on the RawClock; negative: loses
  Duration tolerance{};      // the wall clock is no further from the line, until there is another

  // A line through `reading`.
  static ClockLine through(const ClockReading& reading, PartsPerBillion rate) noexcept;
  // The line through `reading` that follows `line`. Its rate is what the wall clock gained since
  // `rate_from`, which becomes `reading`. While these two are too close together (kExactness), and
  // if the wall clock seems to be on `line`, so that reading the clocks only takes longer or less
  // than then, the rate is that of `line`, and `rate_from` stays.
  static ClockLine after(const ClockLine& line, ClockReading& rate_from,
                         const ClockReading& reading) noexcept;

  bool exists() const noexcept { return raw != RawTime(); }
  // What the wall clock shows at `t`; nullopt: there is no line, or it is too old.
  std::optional<Time> at(RawTime t) const noexcept;
  // How far from it a later line of the same PC begins: so far the clock was slewed or set. Zero if
  // one of them does not exist; kUnknownClockError if this one is too old.
  Duration left_by(const ClockLine& later) const noexcept;
  // When bytes came that the kernel stamped with this PC's wall clock: as exactly as the line,
  // which is this PC's, allows, and never too early. `now` if the line does not show it, because
  // the clock was set or slewed since then, or there is no stamp.
  RawTime arrival(std::optional<Time> arrived, RawTime now) const noexcept;
  // Whether all that this line allows is allowed by `other`, too, for ever.
  bool is_within(const ClockLine& other) const noexcept;
  // Whether `reading` proves that the wall clock was on the line.
  bool shows(const ClockReading& reading) const noexcept;
  // Whether this PC's wall clock is on the line, which is its own. Three clocks are read; up to
  // ten times as many if it is not.
  bool holds() const noexcept;

  friend bool operator==(const ClockLine& a, const ClockLine& b) = default;
};

// The times of a question to another PC and of its answer, by the RawClocks of both. A time of
// sending is read before the bytes leave, one of arrival after they came.
struct HeartbeatTimes {
  RawTime asked;     // this PC sent the question
  RawTime received;  // there
  RawTime sent;      // the answer, there
  RawTime answered;  // it arrived here
};

}  // namespace dssm::clock
