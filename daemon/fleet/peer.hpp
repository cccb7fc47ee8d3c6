// SPDX-License-Identifier: Apache-2.0
//
// One peer: a configured one, or a host that mDNS finds. Peers decides what to do with it and
// changes it; PeerReport shows it to people.
#pragma once

#include <dssm/host_state.hpp>
#include <dssm/time.hpp>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "daemon/fleet/peer_connection.hpp"
#include "daemon/fleet/service_record.hpp"

namespace dssm::daemon {

// What a connection that is up is used for.
//
//   none ──up──▶ in_use        the first connection to that host: requests, catalog, heartbeat
//        ──up──▶ standing_by   another one to that host is in use; takes over when that one ends
//        ──up──▶ self          this very dssmd answers
//        ──up──▶ refused       the host has this host's id (duplicate) or its name (namesake)
//   any of them ──down──▶ none
enum class PeerUse : unsigned char { none, in_use, standing_by, self, refused };

// Why a peer is not connected to, or a warning that concerns it. No reason: there is no problem.
struct PeerProblem {
  HostReason reason = HostReason::none;
  std::string text = {};  // for people
};

struct Peer {
  // Of a peer that mDNS found.
  struct Found {
    FoundHost host;
    bool listed = true;  // mDNS still knows it
    MonoTime since{};
    std::vector<wire::Address> usable;  // of its addresses; empty: see `obstacle`
    PeerProblem obstacle;
  };

  bool is_configured() const noexcept { return !found; }
  bool is_up() const noexcept { return use != PeerUse::none; }
  // While it is up:
  const wire::Greeting& them() const { return *connection->them(); }

  std::optional<Found> found;                  // nothing: it is configured
  std::unique_ptr<PeerConnection> connection;  // nullptr: a found host that is not dialed
  PeerUse use = PeerUse::none;
  bool tried = false;  // the first attempt to connect is over, or the host's streams are known
  bool logged_down = false;  // the log says that it is not up
  bool leaving = false;      // it is not configured any more
  PeerProblem warning;       // while it is up
};

}  // namespace dssm::daemon
