// SPDX-License-Identifier: Apache-2.0
//
// How far another PC's RawClock is from this one's, measured with heartbeats. No I/O.
// docs/clocks.md "Measured between two PCs" derives it.
//
// The question arrives after it was sent, and the answer too, so each heartbeat bounds the
// difference from above and from below (the four timestamps of NTP, RFC 5905, but both ends of the
// interval are kept: no delay is assumed to be the same in both directions). Nothing slews or sets
// these clocks, so heartbeats of a minute are combined: each two of them bound how fast the clocks
// depart from each other, and with that the difference at later moments.
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
  static constexpr std::size_t kMaxHeartbeats = 128;
  // Two oscillators depart from each other by less than this. Twice what the kernel can correct of
  // one of them (adjtimex(2): 500 ppm).
  static constexpr PartsPerBillion kMaxRate = 1'000'000;
  // By so much at most that rate changes in a second: oscillators change with temperature, by about
  // 1 ppm per kelvin at the worst, and a PC warms up by less than 10 K in a minute.
  static constexpr PartsPerBillion kMaxRateChange = 160;

  // Their clock minus this one, and how fast that grows in the next 3 s.
  struct Difference {
    Duration least{}, greatest{};
    PartsPerBillion slowest = 0, fastest = 0;
  };

  // Heartbeats that exclude each other show that one of the clocks stood still (the PC slept, or a
  // virtual machine was moved): then only the newest one counts. False: its times are impossible,
  // or a later one was answered before, and it is ignored.
  bool add_untrusted(const HeartbeatTimes& times) noexcept;
  // The same for the other PC's heartbeats: `times` are those of this PC's answer to one of them,
  // and of the next one. Between the two is about a second, in which a clock may have stood still.
  // So `times` are ignored unless earlier heartbeats of this PC count; and if they exclude these,
  // nothing is known until this PC's next heartbeat.
  void add_returned_untrusted(const HeartbeatTimes& times) noexcept;
  void clear() noexcept { heartbeats_.clear(); }

  // At `now`. nullopt: there is no heartbeat within kWindow before it, or one after it.
  std::optional<Difference> at(RawTime now) const noexcept;

  // The shortest round trip of this PC's heartbeats in the window, without the time that the other
  // PC took to answer; zero: there is none.
  Duration best_round_trip() const noexcept;

 private:
  // What a heartbeat says of the difference at one moment.
  struct Bound {
    RawTime at{};
    Duration difference{};
  };
  struct Heartbeat {
    RawTime answered;
    Bound least, greatest;
    std::optional<Duration> round_trip;  // none: it is the other PC's heartbeat
  };
  // What two heartbeats say of later moments:
  //   difference <= later.difference + (now - later.at) * rate
  //                 + kMaxRateChange / 2 * (now - later.at) * (now - since)
  struct Limit {
    Bound later;
    RawTime since{};
    double rate_ppb = 0;

    double at(RawTime now) const noexcept;  // [ns]
  };
  // The difference from above, or with the opposite sign from below.
  struct Side {
    Limit limit;
    double fastest_ppb = 0;  // what it gains
  };

  static std::optional<Heartbeat> heartbeat_untrusted(const HeartbeatTimes& times) noexcept;
  // False: the heartbeats exclude each other.
  bool add(const Heartbeat& newest) noexcept;
  Side find_side(bool from_above, RawTime when) const noexcept;
  void find_sides() noexcept;
  bool is_excluded(const Heartbeat& newest) const noexcept;

  std::deque<Heartbeat> heartbeats_;  // oldest first
  Side above_, below_;  // by the two heartbeats that say most about the second after the newest
};

}  // namespace dssm::clock
