// SPDX-License-Identifier: Apache-2.0
#include "daemon/service/clock_policies.hpp"

#include <fnmatch.h>

namespace dssm::daemon {

ClockDemand ClockPolicies::demand_for(const StreamId& id) const {
  const std::string full = id.name + ":" + std::to_string(id.id);
  for (const Exception& exception : exceptions) {
    const char* pattern = exception.pattern.c_str();
    if (::fnmatch(pattern, id.name.c_str(), 0) && ::fnmatch(pattern, full.c_str(), 0)) continue;
    return {exception.policy,
            exception.limit == Duration::zero() ? general.limit : exception.limit};
  }
  return general;
}

}  // namespace dssm::daemon
