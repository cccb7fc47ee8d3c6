// SPDX-License-Identifier: Apache-2.0
//
// Which clocks are good enough for which streams: the configuration keys clock_policy, clock_limit
// and clock_streams.
#pragma once

#include <dssm/clock_status.hpp>
#include <dssm/stream.hpp>
#include <dssm/time.hpp>
#include <string>
#include <vector>

namespace dssm::daemon {

struct ClockDemand {
  ClockPolicy policy = ClockPolicy::enforce;
  Duration limit =
      std::chrono::microseconds(1500);  // the greatest clock error that reads by time accept

  friend bool operator==(const ClockDemand& a, const ClockDemand& b) = default;
};

struct ClockPolicies {
  // Another demand for some streams. The first that matches counts.
  struct Exception {
    std::string pattern;  // of the stream's name, or "NAME:ID", as in fnmatch(3)
    ClockPolicy policy = ClockPolicy::enforce;
    Duration limit{};  // 0: the general one

    friend bool operator==(const Exception& a, const Exception& b) = default;
  };

  ClockDemand general;
  std::vector<Exception> exceptions;

  ClockDemand demand_for(const StreamId& id) const;

  friend bool operator==(const ClockPolicies& a, const ClockPolicies& b) = default;
};

}  // namespace dssm::daemon
