// SPDX-License-Identifier: Apache-2.0
//
// How far another PC's RawClock is from this one's, measured with heartbeats. No I/O.
// docs/clocks.md "Measured between two PCs" derives it.
//
// The other PC reads its clock after the question was sent and before the answer was here, so each
// heartbeat bounds the difference by its round trip (as NTP, RFC 5905, but both ends of the
// interval are kept: no delay is assumed to be the same in both directions). Nothing slews or sets
// these clocks, so heartbeats of a minute are combined: all of them together bound how fast the
// clocks depart from each other, and so what the best of them says of the present moment.
//
//   threads  one
#pragma once

#include <deque>
#include <dssm/time.hpp>
#include <optional>

#include "core/clock/clock_line.hpp"

namespace dssm::clock {

class PairMeasurement {
 public:
  // Heartbeats that are older are not used.
  static constexpr Duration kWindow = std::chrono::seconds(64);
  static constexpr std::size_t kMaxHeartbeats = 64;
  // Two oscillators depart from each other by less than this. Twice what the kernel can correct of
  // one of them (adjtimex(2): 500 ppm).
  static constexpr PartsPerBillion kMaxRate = 1'000'000;
  // By so much at most does that rate change within kWindow: oscillators change with temperature,
  // by about 1 ppm per kelvin at the worst.
  static constexpr PartsPerBillion kMaxRateChange = 10'000;

  // Their clock minus this one, and how fast that grows.
  struct Difference {
    Duration least{}, greatest{};
    PartsPerBillion slowest = 0, fastest = 0;
  };

  // Impossible times are ignored. Heartbeats that exclude each other show that one of the clocks
  // stood still (the PC slept, or a virtual machine was moved): then only the newest one counts.
  void add_untrusted(const HeartbeatTimes& times) noexcept;
  void clear() noexcept { heartbeats_.clear(); }

  // At `now`, not before the last heartbeat. nullopt: there is none within kWindow.
  std::optional<Difference> at(RawTime now) const noexcept;

  // The shortest round trip in the window; zero: there is none.
  Duration best_round_trip() const noexcept;

 private:
  struct Heartbeat {
    RawTime answered;
    Duration least, greatest;  // of the difference then
    Duration round_trip;
  };

  void find_rate() noexcept;

  std::deque<Heartbeat> heartbeats_;  // oldest first
  PartsPerBillion slowest_ = -kMaxRate, fastest_ = kMaxRate;
};

}  // namespace dssm::clock
