// SPDX-License-Identifier: Apache-2.0
//
// mDNS answers from somebody who keeps to no rule: no Avahi stands between them and the network.
#pragma once

#include <cstdint>
#include <string>

#include "core/base/unique_fd.hpp"

namespace dssm::test {

class MdnsFlood {
 public:
  // To be constructed on the PC that they shall come from (Inside); sends from any thread.
  //   interface_address  the PC's IPv4 address, "10.77.0.2"
  explicit MdnsFlood(const std::string& interface_address);

  // Announces hosts 'flood0@...', 'flood1@...' and so on: each a service with a good record and a
  // host id of its own, at an address where nobody answers, to be forgotten after ttl_s.
  void announce_hosts(int count, std::uint32_t ttl_s) const;

 private:
  UniqueFd socket_;
};

}  // namespace dssm::test
