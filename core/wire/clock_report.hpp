// SPDX-License-Identifier: Apache-2.0
//
// What a host reports of its clock to others (ClockReport in common.proto), as a value: a clock
// snapshot, and the sync chain through which the clock reaches its reference; and what it states of
// the clocks of others (ClockPair in catalog.proto). The one encoder and decoder of both.
// docs/clocks.md "Between two PCs".
#pragma once

#include <cstdint>
#include <dssm/clock_status.hpp>
#include <dssm/time.hpp>
#include <optional>
#include <string>
#include <vector>

#include "catalog.pb.h"
#include "common.pb.h"
#include "core/clock/clock_line.hpp"
#include "core/wire/address.hpp"
#include "core/wire/host_id.hpp"

namespace dssm::wire {

// One clock of a sync chain.
struct ClockLink {
  HostId host{};
  Duration bound = kUnknownClockError;  // >= 0: from the time that this host's chronyd keeps

  friend bool operator==(const ClockLink& a, const ClockLink& b) = default;
};

struct ClockReport {
  // A chain that is longer has a loop.
  static constexpr std::size_t kMaxLinks = 8;
  static constexpr std::size_t kMaxAddresses = 32;

  ClockSnapshot clock;           // bound: of its samples' times, against `anchor`
  std::string boot_id;           // empty: not known
  std::vector<ClockLink> chain;  // this clock, the one it follows, the one that that follows ...
  HostId anchor{};               // the link of the chain against which samples are stamped
  bool bound_is_root = false;    // clock.bound is clock.root_bound: it follows no host
  bool root_is_utc = false;      // false: the root of its time is a PC that follows no other
  // How far two clocks are apart is also measured (docs/clocks.md "Measured between two PCs"):
  clock::ClockLine line;     // what the clock shows at each moment, until another line is reported
  std::int64_t setting = 0;  // changes when the clock is set; 0: not known
  Time setting_from{};       // times from here on are of this setting
  // If not 1970: the clock was set back, and it shows times before setting_from again. Samples that
  // were written after this was first reported are of this setting if their times are from here on.
  Time settled_from{};
  // By how much its chronyd's time was corrected in all, since its dssmd runs: with each correction
  // that time leaves what others measured of it.
  Duration corrected{};
  std::string reference;  // the host or address that it follows, for people
  std::vector<IpAddress>
      addresses;     // its own: others recognize the host that their chronyd follows
  MonoTime as_of{};  // when this was so, by CLOCK_MONOTONIC of this PC
  std::optional<clock::HeartbeatTimes> heartbeat;  // that this report answered; not sent

  bool has_bound() const noexcept { return clock.bound != kUnknownClockError; }
  // Whether both have the same kernel, and so the same clock.
  bool shares_clock_with(const ClockReport& other) const noexcept {
    return !boot_id.empty() && boot_id == other.boot_id;
  }
  // The link of `host`. kUnknownClockError: it is not in the chain.
  Duration distance_from(const HostId& host) const noexcept;

  // As it is at `now` without a later report: all bounds have grown.
  ClockReport at(MonoTime now) const;
};

void to_message(const ClockReport& report, proto::ClockReport& out);

// Values beyond their limits count as unknown.
ClockReport clock_report_untrusted(const proto::ClockReport& message, MonoTime as_of);

// Of one host: it connects to at most 256 that it found and those that it is configured with.
inline constexpr std::size_t kMaxClockPairs = 512;

void to_message(const ClockPair& pair, proto::ClockPair& out);

// Values beyond their limits count as unknown, and names that no host can have as empty. Text is
// printable, and cut off when it is too long.
ClockPair clock_pair_untrusted(const proto::ClockPair& message);

}  // namespace dssm::wire
