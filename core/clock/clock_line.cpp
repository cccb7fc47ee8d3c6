// SPDX-License-Identifier: Apache-2.0
#include "core/clock/clock_line.hpp"

#include <algorithm>

namespace dssm::clock {
namespace {

// A process may lose its processor between two readings; again and again it does not.
constexpr int kTries = 5;

// What is allowed for reading two clocks, however fast that is.
constexpr Duration kLeastWidth = std::chrono::microseconds(2);

// The wall clock between two readings of the RawClock.
struct Reading {
  RawTime before;
  Time wall;
  RawTime after;

  static Reading now() noexcept {
    const RawTime before = RawClock::now();
    const Time wall = WallClock::now();
    return {before, wall, RawClock::now()};
  }
  Duration width() const noexcept { return after - before; }
};

}  // namespace

ClockLine ClockLine::now(PartsPerBillion rate) noexcept {
  Reading best = Reading::now();
  for (int i = 1; i < kTries && best.width() > kLeastWidth / 4; ++i) {
    const Reading reading = Reading::now();
    if (reading.width() < best.width()) best = reading;
  }
  // Later readings may take twice as long.
  return {best.before + best.width() / 2, best.wall, rate,
          kMaxOff + std::max(kLeastWidth, 3 * best.width())};
}

std::optional<Time> ClockLine::at(RawTime t) const noexcept {
  // A line may begin after `t`: it is of another PC, whose RawClock is known within bounds.
  if (!exists() || t < raw - kMaxAge || t > raw + kMaxAge) return std::nullopt;
  const Duration age = t - raw;
  return wall + age +
         Duration(static_cast<std::int64_t>(static_cast<double>(age.count()) *
                                            static_cast<double>(rate) / 1e9));
}

[[gnu::hot]] bool ClockLine::holds() const noexcept {
  for (int i = 0; i < kTries; ++i) {
    const Reading reading = Reading::now();
    if (kMaxOff + reading.width() > tolerance) continue;
    const std::optional<Time> first = at(reading.before), last = at(reading.after);
    return first && last && reading.wall >= *first - kMaxOff && reading.wall <= *last + kMaxOff;
  }
  return false;  // this PC now takes longer to read its clocks: others have to know
}

}  // namespace dssm::clock
