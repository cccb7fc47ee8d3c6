// SPDX-License-Identifier: Apache-2.0
//
// What people and programs of this PC see of the peers: the list of hosts, and what is wrong with
// them.
//
// One host may be several peers (two configured addresses, or configured and found). Each
// configured peer has an entry. A found host has one unless the entry of a configured peer shows
// the same dssmd; what mDNS finds with this host's own id has one as soon as it is known to be
// another dssmd. The values of the host's connection (clock, streams) are shown once.
#pragma once

#include <list>
#include <string>
#include <vector>

#include "daemon/fleet/catalog.hpp"
#include "daemon/fleet/peer.hpp"
#include "local.pb.h"

namespace dssm::daemon {

// A view, to be used at once: of `peers` as they are, seen from the host `self`.
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
