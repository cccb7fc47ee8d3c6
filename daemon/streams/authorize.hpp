// SPDX-License-Identifier: Apache-2.0
//
// Decides which client may do what. Each request of a program of this PC (LocalService) and of
// another host or remote program (DataCommunicator) passes an Authorizer once, before anything else
// is done for it.
//
//   Identity   who asks: of a local program as the kernel reports it (SO_PEERCRED), of a remote one
//              its address, its greeting and, when the connection is encrypted, whom its
//              certificate names; the greeting is verified only against that
//   Action     what is asked for; action_of() derives it from the request
//
// authorize() allows everything today: which clients can connect at all is decided by the
// permissions of the Unix socket (socket_group, socket_mode) and by the addresses of the key
// listen.
#pragma once

#include <cstdint>
#include <dssm/result.hpp>
#include <dssm/stream.hpp>
#include <functional>
#include <optional>
#include <string>

#include "core/wire/network_protocol.hpp"
#include "local.pb.h"
#include "network.pb.h"

namespace dssm::daemon {

// A value.
struct Identity {
  // Of a program of this PC.
  std::int32_t pid = 0;
  std::uint32_t uid = 0, gid = 0;
  // Of a dssmd or a program on another host.
  std::string address;  // "10.0.0.3:40000"; empty: a program of this PC
  std::string host;
  wire::HostId host_id{};
  std::string certified;  // "host 'pc3'", "program 'viewer'"; empty: not encrypted
  // Of both: as it names itself; printable.
  std::string program;

  bool is_local() const noexcept { return address.empty(); }
  std::string str()
      const;  // "'mapper' (pid 12, uid 1000)", "'mapper' on host 'pc3' at '10.0.0.3:40000'"
};

enum class Action : std::uint8_t {
  greet,  // Hello: to use this dssmd at all
  create,
  open_for_reading,
  open_for_writing,
  offer,  // give a stream back after a restart of dssmd
  close,
  read,     // over the network: Subscribe, Read, GetRange
  publish,  // over the network
  remove,
  set_property,
  get_property,
  list,             // also one stream, and changes of the list
  open_clock,       // the playback clock, for reading and writing
  open_clock_page,  // the state of this PC's clock
  inspect,          // clients, opens, hosts, pairs of clocks and dssmd itself
  ping,             // heartbeat; round trip to another host
};

// What `request` asks for; none: dssmd does not know it.
std::optional<Action> action_of(const local::Request& request) noexcept;
std::optional<Action> action_of(const net::Frame& request) noexcept;

// Whether `identity` may do `action`.
//   stream   that it concerns, as the request names it: not checked, the host may be empty; without
//            a name: none
//   fails    no_permission
Result<void> authorize(const Identity& identity, Action action, const StreamId& stream);

// authorize(), or a test's own rule.
using Authorizer =
    std::function<Result<void>(const Identity& identity, Action action, const StreamId& stream)>;

}  // namespace dssm::daemon
