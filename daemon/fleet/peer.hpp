// SPDX-License-Identifier: Apache-2.0
//
// One peer: a configured one, or a host that mDNS finds. Peers decides what to do with it and
// changes it; PeerReport shows it to people.
#pragma once

#include <dssm/host_state.hpp>
#include <dssm/time.hpp>
#include <list>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "daemon/fleet/catalog.hpp"
#include "daemon/fleet/peer_connection.hpp"
#include "daemon/fleet/service_record.hpp"
#include "local.pb.h"

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
    bool listed = true;  // mDNS still reports it
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
  bool logged_down = false;  // that it is not up
  bool leaving = false;      // it is not configured any more
  PeerProblem warning;       // while it is up
};

// What people and programs of this PC see of the peers: the list of hosts, and what is wrong with
// them. A view, to be used at once: of `peers` as they are, seen from the host `self`.
//
// One host may be several peers (two configured addresses, or configured and found). Each
// configured peer has an entry. A found host has one unless the entry of a configured peer shows
// the same dssmd; what mDNS finds with this host's own id has one as soon as it is known to be
// another dssmd. The values of the host's connection (clock, streams) are shown once.
class PeerReport {
 public:
  PeerReport(const std::list<Peer>& peers, const wire::HostId& self, const Catalog& catalog,
             MonoTime now)
      : peers_(peers), self_(self), catalog_(catalog), now_(now) {}

  // All configured peers, in the order of the configuration, then the found hosts.
  std::vector<local::Host> hosts() const;
  // What a program may have to know when something is not found: "'pc3:13776' (Connection
  // refused)"; empty: all peers are up.
  std::string unavailable_peers() const;
  // A warning that concerns this host itself.
  PeerProblem own_warning() const;

 private:
  bool has_entry(const Peer& peer) const;
  bool is_shown_by_configured(const Peer& found) const;
  bool shows_use(const Peer& peer) const;
  local::Host entry(const Peer& peer) const;
  void add_connection(const Peer& peer, local::Host& entry) const;
  PeerProblem namesake_warning(const Peer& peer) const;

  const std::list<Peer>& peers_;
  const wire::HostId& self_;
  const Catalog& catalog_;
  const MonoTime now_;
};

}  // namespace dssm::daemon
