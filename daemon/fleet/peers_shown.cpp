// SPDX-License-Identifier: Apache-2.0
//
// What Peers tells people: the list of hosts, and what is wrong with them.
#include <algorithm>
#include <utility>

#include "daemon/fleet/peers.hpp"

namespace dssm::daemon {
namespace {

// Of found hosts, in the error message of one request.
constexpr std::size_t kMaxTroublesTold = 8;

// Adds what it says of its clock, aged until now.
void send_clock_of(const wire::Greeting& them, local::Host& host) {
  host.set_clock_bound_ns(to_ns(wire::clock_bound_of(them)));
  wire::send_clock(them, *host.mutable_clock());
}

}  // namespace

std::string Peers::namesake_warning(const Peer& peer) const {
  const wire::Greeting& them = *peer.link->them();
  for (const Peer& other : peers_) {
    if (other.use != Use::in_use || other.link->them()->host_id == them.host_id) continue;
    if (other.link->them()->host != them.host) continue;
    return "the host at '" + other.link->address() + "' is called '" + them.host +
           "' too; give each its own name (key name)";
  }
  return {};
}

// Whether it has an entry of its own. What mDNS tells of our own id has one as soon as it is known
// to be another's.
bool Peers::is_shown(const Peer& peer) const {
  if (!peer.found) return true;
  const bool is_own = peer.found->host.id == self_.host_id;
  const bool is_known = peer.use == Use::not_usable || peer.found->obstacle.has_value();
  return is_own ? is_known : !is_shown_by_configured(peer);
}

// Whether the entry of a configured peer tells of that found host too.
bool Peers::is_shown_by_configured(const Peer& found) const {
  return std::any_of(peers_.begin(), peers_.end(), [&](const Peer& peer) {
    if (peer.found || peer.use == Use::none) return false;
    const wire::Greeting& them = *peer.link->them();
    return them.host_id == found.found->host.id &&
           (found.use != Use::in_use || them.life == found.link->them()->life);
  });
}

// Whether that peer's entry is the one that tells of the host's streams: its connection is in use,
// or the one in use is a found host's, which has no entry then.
bool Peers::shows_use(const Peer& peer) const {
  if (peer.use == Use::in_use) return true;
  if (peer.use != Use::standing_by || peer.found) return false;
  const Peer* used = in_use(peer.link->them()->host_id);
  return used && used->found && used->link->them()->life == peer.link->them()->life;
}

local::Host Peers::shown(const Peer& peer) const {
  local::Host host;
  host.set_clock_bound_ns(to_ns(kUnknownClockError));
  if (peer.found) {
    const FoundHost& found = peer.found->host;
    host.set_name(found.name);
    host.set_host_id(found.id.data(), found.id.size());
    host.set_state("connecting");
    host.set_since_ns(to_ns(loop_.now() - peer.found->since));
    if (peer.use != Use::none) host.add_addresses(peer.link->address());
    for (const wire::Address& address : found.addresses) {
      if (peer.use == Use::none || address.str() != peer.link->address()) {
        host.add_addresses(address.str());
      }
    }
    if (peer.found->obstacle && peer.use == Use::none) {
      host.set_state(peer.found->obstacle->state);
      host.set_error(peer.found->obstacle->error);
      return host;
    }
    if (!peer.link) return host;
  }
  const PeerConnection& link = *peer.link;
  host.set_state(peer.use == Use::self         ? "self"
                 : peer.use == Use::not_usable ? "refused"
                                               : std::string(state_name(link.state())));
  if (!peer.found) {
    host.add_addresses(link.configured().str());
    if (link.address() != link.configured().str()) host.add_addresses(link.address());
  }
  host.set_since_ns(to_ns(link.in_this_state_for()));
  host.set_round_trip_ns(to_ns(link.last_round_trip()));
  host.set_least_round_trip_ns(to_ns(link.least_round_trip()));
  host.set_insecure(link.crosses_network());
  if (link.them()) {
    host.set_name(link.them()->host);
    host.set_host_id(link.them()->host_id.data(), link.them()->host_id.size());
    host.set_version(link.them()->version);
  }
  if (link.why()) host.set_error(link.why()->message);
  if (!peer.warning.empty()) host.set_error(peer.warning);
  if (!shows_use(peer)) return host;
  send_clock_of(*link.them(), host);
  if (const KnownHost* known = catalog_.find(link.them()->host_id)) {
    host.set_streams(static_cast<std::uint32_t>(known->streams.size()));
  }
  if (std::string warning = namesake_warning(peer); !warning.empty()) {
    host.set_error(std::move(warning));
  }
  return host;
}

std::vector<local::Host> Peers::hosts() const {
  std::vector<local::Host> hosts;
  for (const Peer& peer : peers_) {
    if (!is_shown(peer)) continue;
    local::Host& host = hosts.emplace_back(shown(peer));
    host.add_found_by(peer.found ? "mdns" : "peer");
    if (peer.found || peer.use == Use::self || !peer.link->them()) continue;
    const bool is_found = std::any_of(peers_.begin(), peers_.end(), [&](const Peer& other) {
      return other.found && other.found->listed &&
             other.found->host.id == peer.link->them()->host_id;
    });
    if (is_found) host.add_found_by("mdns");
  }
  return hosts;
}

std::string Peers::trouble() const {
  std::string text;
  const auto add = [&](const std::string& who, const std::string& why) {
    text += (text.empty() ? "'" : ", '") + who + "' (" + why + ")";
  };
  std::size_t found_ones = 0;
  for (const Peer& peer : peers_) {
    if (!peer.found) {
      if (peer.link->why()) add(peer.link->configured().str(), peer.link->why()->message);
      continue;
    }
    if (!is_shown(peer)) continue;
    const local::Host host = shown(peer);
    if (peer.use != Use::none || host.error().empty()) continue;
    if (++found_ones <= kMaxTroublesTold) add(host.name(), host.error());
  }
  if (found_ones > kMaxTroublesTold) {
    text += ", and " + std::to_string(found_ones - kMaxTroublesTold) +
            " more (`dssmctl hosts` lists all)";
  }
  return text;
}

std::string Peers::own_warning() const {
  for (const Peer& peer : peers_) {
    if (peer.use == Use::not_usable) return peer.warning;
  }
  return {};
}

}  // namespace dssm::daemon
