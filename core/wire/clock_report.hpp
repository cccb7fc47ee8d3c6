// SPDX-License-Identifier: Apache-2.0
//
// What a host says about its clock (common.proto, ClockStatus), as a value.
#pragma once

#include <array>
#include <cstdint>
#include <dssm/clock_status.hpp>
#include <dssm/time.hpp>
#include <string>
#include <vector>

#include "common.pb.h"
#include "core/clock/sync_chain.hpp"

namespace dssm::wire {

// An address without port; IPv4 as such in IPv6 (::ffff:10.0.0.1).
using IpBytes = std::array<std::uint8_t, 16>;

struct ClockReport {
  static constexpr std::size_t kMostAddresses = 32;

  clock::SyncChain standing;

  // For people.
  ClockStatus status = ClockStatus::unknown;
  ClockReason trouble = ClockReason::none;
  ClockBasis basis = ClockBasis::nothing;
  Duration offset{};
  Duration update_interval{};
  Duration age{};  // since chronyd's last measurement
  std::string reference;
  std::uint16_t stratum = 0;

  // For hosts that follow this one.
  std::vector<IpBytes> addresses;
  clock::RootDistance root;

  MonoTime heard{};  // when this was so, by our own clock

  // As it is at `now`, when nothing more was heard.
  ClockReport at(MonoTime now) const;
};

void to_message(const ClockReport& report, proto::ClockStatus& out);

// Whatever is out of its limits counts as unknown.
ClockReport clock_report_untrusted(const proto::ClockStatus& message, MonoTime heard);

}  // namespace dssm::wire
