// SPDX-License-Identifier: Apache-2.0
//
// What mDNS reports: the dssmd of other hosts, and how this host's own announcements fare. Between
// the finder (Mdns) and the observer of what it finds (Peers).
#pragma once

#include <cstdint>
#include <dssm/host_state.hpp>
#include <string>
#include <vector>

#include "core/wire/address.hpp"
#include "core/wire/network_protocol.hpp"

namespace dssm::daemon {

// A dssmd that was found: never this very one, as far as mDNS knows. A value.
struct FoundHost {
  wire::HostId id{};  // this host's own: of a PC that was copied from this one, or the like
  std::string name;   // "pc2"; two hosts may have the same one
  std::uint32_t protocol_version = 0;
  bool closed = false;  // it listens on its own loopback only: not to be reached
  // Where it may be reached, best first; numbers only, link-local ones with their interface
  // ("[fe80::1%eth0]:13776"). Empty when `closed` and on another PC.
  std::vector<wire::Address> addresses;

  friend bool operator==(const FoundHost&, const FoundHost&) = default;
};

// Called in the thread of the event loop that the finder was given.
class HostFinderObserver {
 public:
  virtual void on_host_found(const FoundHost& host) = 0;  // or something of it has changed
  virtual void on_host_lost(const wire::HostId& id) = 0;  // mDNS does not know it any more
  virtual void on_mdns_state(const MdnsInfo&) {}

 protected:
  ~HostFinderObserver() = default;
};

}  // namespace dssm::daemon
