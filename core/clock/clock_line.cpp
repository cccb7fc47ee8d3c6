// SPDX-License-Identifier: Apache-2.0
#include "core/clock/clock_line.hpp"

#include <algorithm>
#include <cmath>

namespace dssm::clock {
namespace {

// A process may lose its processor between two readings; again and again it does not.
constexpr int kTries = 5;
// More of them before others have to know of a new line: where reading a clock is a system call,
// it may take several times as long for some moments.
constexpr int kTriesToHold = 2 * kTries;

// A clock that has left the line may have come back to it in a longer time.
constexpr Duration kMaxArrivalAge = std::chrono::milliseconds(500);

// What is allowed for reading two clocks, however fast that is.
constexpr Duration kLeastBlur = std::chrono::microseconds(2);

// The wall clock between two readings of the RawClock.
ClockReading read_once() noexcept {
  const RawTime before = RawClock::now();
  const Time wall = WallClock::now();
  const Duration half = (RawClock::now() - before + Duration(1)) / 2;
  return {before + half, wall, half};
}

}  // namespace

ClockReading ClockReading::now() noexcept {
  ClockReading best = read_once();
  for (int i = 1; i < kTries && best.blur > kLeastBlur / 8; ++i) {
    const ClockReading reading = read_once();
    if (reading.blur < best.blur) best = reading;
  }
  return best;
}

ClockLine ClockLine::through(const ClockReading& reading, PartsPerBillion rate) noexcept {
  // Later readings may take half as long again. The wall clock is read in the middle, so their
  // blur is hardly ever an error as well.
  return {reading.raw, reading.wall, rate, kMaxOff + std::max(kLeastBlur, reading.blur * 3 / 2)};
}

ClockLine ClockLine::after(const ClockLine& line, ClockReading& rate_from,
                           const ClockReading& reading) noexcept {
  const Duration age = reading.raw - rate_from.raw;
  const std::optional<Time> expected = line.at(reading.raw);
  const bool is_right = expected && std::chrono::abs(reading.wall - *expected) <= kMaxOff;
  if (is_right || age <= kExactness * (rate_from.blur + reading.blur)) {
    return through(reading, line.rate);
  }
  const double gained = static_cast<double>(((reading.wall - rate_from.wall) - age).count());
  constexpr auto kMax = static_cast<double>(kMaxRate);
  rate_from = reading;
  return through(reading, static_cast<PartsPerBillion>(std::clamp(
                              gained / static_cast<double>(age.count()) * 1e9, -kMax, kMax)));
}

std::optional<Time> ClockLine::at(RawTime t) const noexcept {
  // A line may begin after `t`: it is of another PC, whose RawClock is known within bounds.
  if (!exists() || t < raw - kMaxAge || t > raw + kMaxAge) return std::nullopt;
  const Duration age = t - raw;
  return wall + age + gained(age, rate);
}

Duration ClockLine::left_by(const ClockLine& later) const noexcept {
  if (!exists() || !later.exists()) return {};
  const std::optional<Time> expected = at(later.raw);
  return expected ? std::chrono::abs(later.wall - *expected) : kUnknownClockError;
}

RawTime ClockLine::arrival(std::optional<Time> arrived, RawTime now) const noexcept {
  if (!arrived || !exists() || *arrived < wall || now > raw + kMaxAge || !holds()) return now;
  const Duration shown = *arrived - wall;
  const double elapsed_ns =
      static_cast<double>(shown.count()) / (1 + static_cast<double>(rate) / 1e9);
  const RawTime found =
      raw + Duration(static_cast<std::int64_t>(std::ceil(elapsed_ns))) + tolerance;
  return now - found > kMaxArrivalAge ? now : std::min(found, now);
}

bool ClockLine::is_within(const ClockLine& other) const noexcept {
  return exists() == other.exists() && rate == other.rate &&
         other.left_by(*this) <= other.tolerance - tolerance;
}

[[gnu::hot]] bool ClockLine::shows(const ClockReading& reading) const noexcept {
  const std::optional<Time> expected = at(reading.raw);
  return expected && std::chrono::abs(reading.wall - *expected) <= tolerance - reading.blur;
}

[[gnu::hot]] bool ClockLine::holds() const noexcept {
  for (int i = 0; i < kTriesToHold; ++i) {
    const ClockReading reading = read_once();
    if (shows(reading)) return true;
  }
  return false;  // or reading the clocks takes longer now, which others have to know, too
}

}  // namespace dssm::clock
