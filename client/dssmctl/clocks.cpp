// SPDX-License-Identifier: Apache-2.0
#include "client/dssmctl/clocks.hpp"

#include <algorithm>

namespace dssm::ctl {

void Clocks::add(const SampleInfo& info) {
  const bool known = info.clock_error < kForeignClockError;
  some_unknown_ |= !known;
  if (known) known_errors_.add(info.clock_error);
}

void Clocks::update(const std::vector<HostInfo>& hosts, std::string_view owner) {
  owner_bound_ = kUnknownClockError;  // a host that is not up says nothing about its clock
  for (const HostInfo& host : hosts) {
    if (host.state == HostState::self) {
      two_clocks_ = host.name != owner;
      own_bound_ = host.clock_bound();
    } else if (host.state == HostState::up && host.name == owner) {
      owner_bound_ = host.clock_bound();
    }
  }
}

Duration Clocks::delay_error() const {
  if (!two_clocks_) return Duration::zero();
  Duration stamps = known_errors_.statistics().max;
  if (some_unknown_) stamps = std::max(stamps, owner_bound_);
  return stamps > kUnknownClockError - own_bound_ ? kUnknownClockError : stamps + own_bound_;
}

}  // namespace dssm::ctl
