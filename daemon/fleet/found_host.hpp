// SPDX-License-Identifier: Apache-2.0
//
// What mDNS tells: the dssmd of other hosts, and how this host's own announcements fare. Between
// the finder (Mdns) and those who use what it finds (Peers).
#pragma once

#include <cstdint>
#include <string>
#include <vector>

#include "core/wire/address.hpp"
#include "core/wire/network_protocol.hpp"

namespace dssm::daemon {

// A dssmd that was found: never this very one, as far as mDNS can tell. A value.
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

// How mDNS fares here. A value.
struct MdnsState {
  enum class Phase : std::uint8_t {
    off,      // not wanted (mdns = false)
    waiting,  // there is no Avahi daemon to talk to; tried again and again
    running,
  };
  Phase phase = Phase::off;
  std::string trouble;            // why it waits; or what goes wrong while it runs; may be empty
  std::string avahi_version;      // "avahi 0.8"
  std::uint32_t announced = 0;    // services that are established: streams, and the host itself
  std::uint32_t withheld = 0;     // wanted, but refused or beyond Avahi's limits; see `trouble`
  bool own_host_seen = false;     // our browser sees our own host's service
  std::uint32_t hosts_heard = 0;  // other hosts heard of by multicast, not this PC's own

  friend bool operator==(const MdnsState&, const MdnsState&) = default;
};

// Told in the thread of the event loop that the finder was given.
class HostFinderObserver {
 public:
  virtual void on_host_found(const FoundHost& host) = 0;  // or something of it has changed
  virtual void on_host_lost(const wire::HostId& id) = 0;  // mDNS does not know it any more
  virtual void on_mdns_state(const MdnsState&) {}

 protected:
  ~HostFinderObserver() = default;
};

}  // namespace dssm::daemon
