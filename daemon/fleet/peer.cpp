// SPDX-License-Identifier: Apache-2.0
#include "daemon/fleet/peer.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <utility>

namespace dssm::daemon {
namespace {

constexpr std::size_t kMaxFoundHostsNamed = 8;  // in the error message of one request

void set_state(local::Host& host, HostState state) {
  host.set_state(static_cast<local::Host::State>(state));
}

void set_problem(local::Host& host, HostReason reason, const std::string& text) {
  if (reason == HostReason::none) return;
  host.set_reason(static_cast<local::Host::Reason>(reason));
  host.set_error(text);
}

// Of a found host that is not dialed for this reason.
HostState state_for(HostReason reason) noexcept {
  switch (reason) {
    case HostReason::closed_here:
    case HostReason::closed_there:
      return HostState::closed;
    case HostReason::no_address:
      return HostState::down;
    default:
      return HostState::refused;
  }
}

}  // namespace

// --- which peers have an entry

bool PeerReport::has_entry(const Peer& peer) const {
  if (peer.is_configured()) return true;
  if (peer.found->host.id != self_) return !is_shown_by_configured(peer);
  return peer.use == PeerUse::refused || peer.found->obstacle.reason != HostReason::none;
}

bool PeerReport::is_shown_by_configured(const Peer& found) const {
  return std::any_of(peers_.begin(), peers_.end(), [&](const Peer& peer) {
    if (!peer.is_configured() || !peer.is_up()) return false;
    return peer.them().host_id == found.found->host.id &&
           (found.use != PeerUse::in_use || peer.them().instance_id == found.them().instance_id);
  });
}

// Whether that peer's entry shows the host's clock and streams: its connection is in use, or the
// one in use is a found host's, which then has no entry.
bool PeerReport::shows_use(const Peer& peer) const {
  if (peer.use == PeerUse::in_use) return true;
  if (peer.use != PeerUse::standing_by || !peer.is_configured()) return false;
  return std::any_of(peers_.begin(), peers_.end(), [&](const Peer& other) {
    return other.use == PeerUse::in_use && !other.is_configured() &&
           other.them().host_id == peer.them().host_id &&
           other.them().instance_id == peer.them().instance_id;
  });
}

// --- entries

PeerProblem PeerReport::namesake_warning(const Peer& peer) const {
  const wire::Greeting& them = peer.them();
  for (const Peer& other : peers_) {
    if (other.use != PeerUse::in_use || other.them().host_id == them.host_id) continue;
    if (other.them().host != them.host) continue;
    return {HostReason::namesake,
            fmt::format("the host at '{}' is called '{}' too; give each its own name (key name)",
                        other.connection->address(), them.host)};
  }
  return {};
}

local::Host PeerReport::entry(const Peer& peer) const {
  local::Host host;
  if (!peer.is_configured()) {
    const Peer::Found& found = *peer.found;
    host.set_name(found.host.name);
    host.set_host_id(found.host.id.data(), found.host.id.size());
    set_state(host, HostState::connecting);
    host.set_since_ns(to_ns(now_ - found.since));
    const std::string connected = peer.is_up() ? peer.connection->address() : "";
    if (peer.is_up()) host.add_addresses(connected);
    for (const wire::Address& address : found.host.addresses) {
      if (address.str() != connected) host.add_addresses(address.str());
    }
    if (found.obstacle.reason != HostReason::none && !peer.is_up()) {
      set_state(host, state_for(found.obstacle.reason));
      set_problem(host, found.obstacle.reason, found.obstacle.text);
      return host;
    }
  }
  if (peer.connection) add_connection(peer, host);
  return host;
}

void PeerReport::add_connection(const Peer& peer, local::Host& host) const {
  const PeerConnection& connection = *peer.connection;
  set_state(host, peer.use == PeerUse::self      ? HostState::self
                  : peer.use == PeerUse::refused ? HostState::refused
                                                 : connection.state());
  if (peer.is_configured()) {
    host.add_addresses(connection.configured().str());
    if (connection.address() != connection.configured().str()) {
      host.add_addresses(connection.address());
    }
  }
  host.set_since_ns(to_ns(connection.in_this_state_for()));
  host.set_round_trip_ns(to_ns(connection.last_round_trip()));
  host.set_least_round_trip_ns(to_ns(connection.min_round_trip()));
  host.set_carried_bytes_per_s(connection.carried_bytes_per_s());
  host.set_insecure(connection.is_insecure());
  if (connection.them()) {
    host.set_name(connection.them()->host);
    host.set_host_id(connection.them()->host_id.data(), connection.them()->host_id.size());
    host.set_version(connection.them()->version);
  }
  if (connection.last_error()) {
    set_problem(host, connection.reason(), connection.last_error()->message);
  }
  set_problem(host, peer.warning.reason, peer.warning.text);
  if (!shows_use(peer)) return;
  wire::send_clock(peer.them(), *host.mutable_clock());
  if (const KnownHost* known = catalog_.find(peer.them().host_id)) {
    host.set_streams(static_cast<std::uint32_t>(known->streams.size()));
  }
  const PeerProblem namesake = namesake_warning(peer);
  set_problem(host, namesake.reason, namesake.text);
}

std::vector<local::Host> PeerReport::hosts() const {
  std::vector<local::Host> hosts;
  for (const Peer& peer : peers_) {
    if (!has_entry(peer)) continue;
    local::Host& host = hosts.emplace_back(entry(peer));
    host.add_found_by(peer.is_configured() ? "peer" : "mdns");
    if (!peer.is_configured() || peer.use == PeerUse::self || !peer.connection->them()) continue;
    const bool is_found = std::any_of(peers_.begin(), peers_.end(), [&](const Peer& other) {
      return other.found && other.found->listed && other.found->host.id == peer.them().host_id;
    });
    if (is_found) host.add_found_by("mdns");
  }
  return hosts;
}

// --- what is wrong

std::string PeerReport::unavailable_peers() const {
  std::string text;
  const auto add = [&](const std::string& who, const std::string& error) {
    text += fmt::format("{}'{}' ({})", text.empty() ? "" : ", ", who, error);
  };
  std::size_t found_hosts = 0;
  for (const Peer& peer : peers_) {
    if (peer.is_configured()) {
      const std::optional<Error>& error = peer.connection->last_error();
      if (error) add(peer.connection->configured().str(), error->message);
    } else if (has_entry(peer) && !peer.is_up()) {
      const local::Host host = entry(peer);
      if (host.error().empty()) continue;
      if (++found_hosts <= kMaxFoundHostsNamed) add(host.name(), host.error());
    }
  }
  if (found_hosts > kMaxFoundHostsNamed) {
    text +=
        fmt::format(", and {} more (`dssmctl hosts` lists all)", found_hosts - kMaxFoundHostsNamed);
  }
  return text;
}

PeerProblem PeerReport::own_warning() const {
  const auto refused = std::find_if(peers_.begin(), peers_.end(),
                                    [](const Peer& peer) { return peer.use == PeerUse::refused; });
  return refused == peers_.end() ? PeerProblem{} : refused->warning;
}

}  // namespace dssm::daemon
