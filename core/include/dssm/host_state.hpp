// SPDX-License-Identifier: Apache-2.0
//
// How dssmd sees other hosts, and how it fares with finding them by mDNS. Programs decide by these
// values; people read the sentence beside them (HostInfo::error, MdnsInfo::error).
#pragma once

#include <cstdint>
#include <string>
#include <string_view>

#pragma GCC visibility push(default)  // the library hides everything else
namespace dssm {

enum class HostState : std::uint8_t {
  unknown,  // not a host that dssmd lists
  self,     // this PC
  up,
  connecting,  // not decided yet
  down,        // it cannot be reached
  refused,     // it answers, but the two do not fit together: see HostReason
  closed,      // found by mDNS, but its keys or those of this PC do not allow the connection
};

// Why a host is not up, or which warning concerns it.
enum class HostReason : std::uint8_t {
  none,
  name_not_found,      // its address is a name that cannot be resolved
  connection_refused,  // nothing listens at its address
  no_answer,           // nothing answers at its address, or the connection broke
  no_greeting,         // what listens there does not answer as a dssmd
  not_accepted,        // one of both refuses the other: protocol version, limits, a wrong host id
  no_address,          // it is announced without an address that can be reached from here
  closed_there,        // it listens on its own loopback only
  closed_here,         // the dssmd of this PC connects to others only with insecure = true
  spare_address,       // another address of the same host is in use
  duplicate,           // another dssmd has the same host id
  namesake,            // another host has the same name
};

enum class MdnsPhase : std::uint8_t {
  off,      // the configuration says so
  waiting,  // there is no Avahi daemon to talk to; dssmd retries
  running,
};

// How dssmd fares with finding other hosts by mDNS.
struct MdnsInfo {
  MdnsPhase phase = MdnsPhase::off;
  std::string error;              // why it waits, or what goes wrong while it runs; may be empty
  std::string avahi_version;      // "avahi 0.8"
  std::uint32_t announced = 0;    // services: streams, and the host itself
  std::uint32_t withheld = 0;     // services that could not be announced: see `error`
  bool own_host_seen = false;     // this host's own announcement is visible here
  std::uint32_t hosts_heard = 0;  // other hosts heard of by multicast, this PC's own left out

  friend bool operator==(const MdnsInfo&, const MdnsInfo&) = default;
};

// "up", "connection refused", "waiting" ...; static storage.
std::string_view name_of(HostState state) noexcept;
std::string_view name_of(HostReason reason) noexcept;
std::string_view name_of(MdnsPhase phase) noexcept;

}  // namespace dssm
#pragma GCC visibility pop
