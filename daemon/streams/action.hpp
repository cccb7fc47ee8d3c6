// SPDX-License-Identifier: Apache-2.0
//
// What Rights decide about. Each request of a program of this PC (LocalService) and of another host
// or remote program (DataCommunicator) passes Rights::check() before anything else is done for it.
//
//   Identity   who asks: of a local program as the kernel reports it (SO_PEERCRED), of a remote one
//              its address, its greeting and, when the connection is encrypted, whom its
//              certificate names; the greeting is verified only against that
//   Action     what is asked for; action_of() derives it from the request
//
// Which clients can connect at all is decided by the permissions of the Unix socket (socket_group,
// socket_mode) and by the keys listen and credentials.
#pragma once

#include <cstdint>
#include <dssm/result.hpp>
#include <dssm/stream.hpp>
#include <optional>
#include <string>
#include <vector>

#include "core/wire/network_protocol.hpp"
#include "core/wire/tls_credentials.hpp"
#include "local.pb.h"
#include "network.pb.h"

namespace dssm::daemon {

// Who is charged for what a remote client takes: whom its certificate names, or its address without
// the port, all of this PC as one.
std::string account_of(const std::string& address, const wire::CertifiedPeer* certified);

// A value.
struct Identity {
  // Of a program of this PC.
  std::int32_t pid = 0;
  std::uint32_t uid = 0, gid = 0;
  std::vector<std::uint32_t> groups;  // besides gid
  // Of a dssmd or a program on another host.
  std::string address;  // "10.0.0.3:40000"; empty: a program of this PC
  std::string host;
  wire::HostId host_id{};
  std::optional<wire::CertifiedPeer> certified;  // none: not encrypted
  // Of both: as it names itself; printable.
  std::string program;

  bool is_local() const noexcept { return address.empty(); }
  // Who is charged for what this client has dssmd keep (key max_share): "user 1000", "host 'pc2'",
  // "'10.0.0.3'"; empty: a user without limits.
  std::string account() const;
  std::string str()
      const;  // "'mapper' (pid 12, uid 1000)", "'mapper' on host 'pc3' at '10.0.0.3:40000'"
};

enum class Action : std::uint8_t {
  greet,  // Hello: to use this dssmd at all
  create,
  open_for_reading,
  open_for_writing,
  offer_for_reading,  // give a stream back after a restart of dssmd
  offer_for_writing,
  close,
  open_channel,  // over the network: Open, of which it is not known yet what for
  read,          // over the network: Subscribe, Read, GetRange
  publish,       // over the network
  remove,
  set_property,
  get_property,
  describe,         // the type of a stream
  see,              // of a stream: that it is there, what it is, and who may do what
  list,             // and changes of it, and nodes; what the asker may not see is left out
  open_clock,       // the playback clock, for reading and writing; and whom it follows
  open_clock_page,  // the state of this PC's clock
  inspect,          // clients, opens, hosts, pairs of clocks and dssmd itself
  ping,             // heartbeat; round trip to another host
  set_users,        // over the network: which programs use the own end of a channel
};

// What `request` asks for; none: dssmd does not know it.
std::optional<Action> action_of(const local::Request& request) noexcept;
std::optional<Action> action_of(const net::Frame& request) noexcept;

}  // namespace dssm::daemon
