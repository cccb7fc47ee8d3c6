// SPDX-License-Identifier: Apache-2.0
//
// A PC's wall clock as a line over its RawClock. While no program sets or slews the wall clock
// anew, the line says what it shows; dssmd tells other hosts a new line as soon as the wall clock
// has left the old one by more than kTolerance. So they know that clock at each moment, and not
// only when they asked. docs/clocks.md "Measured between two PCs".
#pragma once

#include <dssm/time.hpp>
#include <optional>

#include "core/base/time.hpp"
#include "core/clock/clock_bound.hpp"

namespace dssm::clock {

struct ClockLine {
  // How far the wall clock may be from the line that counts.
  static constexpr Duration kTolerance = std::chrono::microseconds(10);
  // A line that is older is not used: dssmd draws a new one much earlier.
  static constexpr Duration kMaxAge = std::chrono::hours(1);
  // Faster or slower than this no program can make the wall clock (adjtimex(2): a tenth).
  static constexpr PartsPerBillion kMaxRate = 200'000'000;

  RawTime raw{};             // where the line begins; zero: there is none
  Time wall{};               // what the wall clock showed there
  PartsPerBillion rate = 0;  // the wall clock gains so much on the RawClock; negative: loses

  bool exists() const noexcept { return raw != RawTime(); }
  // What the wall clock shows at `t`; nullopt: there is no line, or it is too old.
  std::optional<Time> at(RawTime t) const noexcept;

  friend bool operator==(const ClockLine& a, const ClockLine& b) = default;
};

// A question to another PC, and its answer.
struct HeartbeatTimes {
  RawTime asked;     // this PC's RawClock, before the question was sent
  RawTime theirs;    // the other PC's, in between
  RawTime answered;  // this PC's, after the answer was here
};

}  // namespace dssm::clock
