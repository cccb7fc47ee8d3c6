// SPDX-License-Identifier: Apache-2.0
#include "daemon/fleet/peers.hpp"

#include <algorithm>
#include <utility>

#include "core/base/text.hpp"
#include "daemon/base/message_ids.hpp"
#include "daemon/fleet/service_record.hpp"

namespace dssm::daemon {
namespace {

std::string describe(const PeerConnection& link) {
  return "host '" + link.them()->host + "' ('" + link.address() + "')";
}

}  // namespace

Peers::Peers(const EventLoop& loop, Resolver& resolver, const std::vector<wire::Address>& peers,
             wire::Greeting self, Catalog& catalog, Logger& logger)
    : loop_(loop),
      resolver_(resolver),
      self_(std::move(self)),
      catalog_(catalog),
      logger_(logger),
      settled_(peers.empty()),
      settle_timer_(EventSource::timer(loop, [this] { settle(); })),
      tend_soon_(EventSource::timer(loop, [this] { tend(); })) {
  if (!settled_) settle_timer_.enable_in(kSettleTime);
  PeerConnection::Observer& observer = *this;
  for (const wire::Address& peer : peers) {
    peers_.emplace_back().link =
        std::make_unique<PeerConnection>(loop, resolver, peer, self_, observer);
  }
}

Peers::~Peers() = default;

Peers::Peer& Peers::peer_of(const PeerConnection& link) {
  return *std::find_if(peers_.begin(), peers_.end(),
                       [&](const Peer& peer) { return peer.link.get() == &link; });
}

Peers::Peer* Peers::found_host(const wire::HostId& id) {
  const auto found = std::find_if(peers_.begin(), peers_.end(), [&](const Peer& peer) {
    return peer.found && peer.found->host.id == id;
  });
  return found == peers_.end() ? nullptr : &*found;
}

const Peers::Peer* Peers::in_use(const wire::HostId& id) const {
  const auto found = std::find_if(peers_.begin(), peers_.end(), [&](const Peer& peer) {
    return peer.use == Use::in_use && peer.link->them()->host_id == id;
  });
  return found == peers_.end() ? nullptr : &*found;
}

bool Peers::is_up_as_configured(const wire::HostId& id) const {
  return std::any_of(peers_.begin(), peers_.end(), [&](const Peer& peer) {
    return !peer.found && peer.use != Use::none && peer.use != Use::self &&
           peer.link->them()->host_id == id;
  });
}

PeerConnection* Peers::link_to(const wire::HostId& id) {
  const Peer* peer = in_use(id);
  return peer ? peer->link.get() : nullptr;
}

// --- found hosts

void Peers::expect_finder(bool insecure) {
  insecure_ = insecure;
  mdns_.phase = MdnsState::Phase::waiting;
  finder_is_searching_ = true;
  settled_ = false;
  settle_timer_.enable_in(kSettleTime);
}

void Peers::on_host_found(const FoundHost& host) {
  Peer* known = found_host(host.id);
  if (!known) {
    const auto count = std::count_if(peers_.begin(), peers_.end(),
                                     [](const Peer& peer) { return peer.found.has_value(); });
    if (static_cast<std::size_t>(count) >= kMaxFoundHosts) {
      if (std::exchange(told_too_many_, true)) return;
      return logger_.warning("mDNS finds more than " + std::to_string(kMaxFoundHosts) +
                                 " hosts; further ones, such as '" + host.name +
                                 "', are not followed (name those that are needed as peers, and "
                                 "look with `avahi-browse -r _dssm._tcp` for who announces them)",
                             {.peer = host.name, .message_id = message_id::kHostRefused});
    }
    known = &peers_.emplace_back();
    known->found = Found{};
    known->found->since = loop_.now();
  }
  known->found->listed = true;
  known->found->host = host;
  if (host.addresses.size() > kMaxAddressesOfHost) {
    known->found->host.addresses.resize(kMaxAddressesOfHost);
  }
  tend_soon_.enable_in(Duration::zero());
}

void Peers::on_host_lost(const wire::HostId& id) {
  Peer* known = found_host(id);
  if (!known) return;
  known->found->listed = false;
  tend_soon_.enable_in(Duration::zero());
}

void Peers::on_mdns_state(const MdnsState& state) {
  mdns_ = state;
  finder_is_searching_ = state.phase == MdnsState::Phase::running;
  settle_if_decided();
}

Peers::Occupied Peers::occupied() const {
  Occupied occupied;
  for (const Peer& peer : peers_) {
    if (peer.use != Use::none) occupied.emplace(peer.link->address(), &*peer.link->them());
  }
  return occupied;
}

// Decides where a connection to that host may go, and why to nowhere.
void Peers::look_at(Found& found, const Occupied& occupied) const {
  const FoundHost& host = found.host;
  const std::string who = "host '" + host.name + "'";
  found.usable.clear();
  found.obstacle.reset();
  if (host.protocol_version != wire::kNetworkProtocolVersion) {
    found.obstacle = {
        "refused", wire::other_protocol_version("dssmd of " + who, host.protocol_version).message};
    return;
  }
  found.obstacle = {"down", who +
                                " is announced without an address that can be reached from here; "
                                "check the network interfaces of both"};
  if (host.closed) {
    found.obstacle = {"closed", who +
                                    " listens on its own loopback only; to share its streams set "
                                    "listen and insecure there, see docs/configuration.md"};
  }
  for (const wire::Address& address : host.addresses) {
    const std::vector<wire::SocketAddress> numbers = wire::resolve_number(address);
    if (numbers.empty()) continue;
    if (!insecure_ && !numbers.front().is_loopback()) {
      found.obstacle = {"closed", who +
                                      " is on another PC, and this dssmd connects to others only "
                                      "with insecure = true, see docs/configuration.md"};
      continue;
    }
    const auto occupant = occupied.find(numbers.front().str());
    if (occupant != occupied.end() && occupant->second->host_id != host.id) {
      found.obstacle = {"refused", who + " is said to be at '" + address.str() + "', where host '" +
                                       occupant->second->host + "' answers"};
      continue;
    }
    found.usable.push_back(address);
  }
  if (!found.usable.empty()) found.obstacle.reset();
  if (found.obstacle && host.id == self_.host_id) {
    found.obstacle->error =
        "another dssmd is announced with this host's name '" + self_.host +
        "' and machine id, but cannot be asked who it is: " + found.obstacle->error;
  }
}

void Peers::tend() {
  const Occupied now_occupied = occupied();
  for (auto next = peers_.begin(); next != peers_.end();) {
    const auto peer = next++;
    if (peer->found) {
      tend_found_host(peer, now_occupied);
    } else if (peer->leaving && peer->use == Use::none) {
      peers_.erase(peer);
    }
  }
  settle_if_decided();
  if (on_change_) on_change_();
}

// May erase `peer`.
void Peers::tend_found_host(std::list<Peer>::iterator peer, const Occupied& now_occupied) {
  PeerConnection::Observer& observer = *this;
  Found& found = *peer->found;
  const std::vector<wire::Address> before = found.usable;
  look_at(found, now_occupied);
  const bool is_needed = !is_up_as_configured(found.host.id);
  const bool is_up = peer->use == Use::in_use || (peer->use != Use::none && is_needed);
  if (!found.listed && !is_up) {
    peers_.erase(peer);
  } else if (!is_up && (!is_needed || found.obstacle)) {
    peer->link.reset();
    peer->use = Use::none;
    peer->warning.clear();
  } else if (!peer->link) {
    peer->link = std::make_unique<PeerConnection>(loop_, resolver_, found.host.id, found.usable,
                                                  self_, observer);
  } else if (!found.usable.empty() && found.usable != before) {
    peer->link->set_addresses(found.usable);
  }
}

// --- configured peers change

void Peers::set_configured(const std::vector<wire::Address>& peers) {
  PeerConnection::Observer& observer = *this;
  std::vector<wire::Address> known;
  for (Peer& peer : peers_) {
    if (peer.found || peer.leaving) continue;
    const wire::Address& address = peer.link->configured();
    known.push_back(address);
    if (std::find(peers.begin(), peers.end(), address) != peers.end()) continue;
    peer.leaving = true;
    // When that is through, tend() takes it away; what waits for its answers is told.
    peer.link->drop({Errc::unavailable, "it is not among the peers any more (key peers)"});
  }
  const auto first_found = std::find_if(peers_.begin(), peers_.end(),
                                        [](const Peer& peer) { return peer.found.has_value(); });
  for (const wire::Address& address : peers) {
    if (std::find(known.begin(), known.end(), address) != known.end()) continue;
    peers_.emplace(first_found)->link =
        std::make_unique<PeerConnection>(loop_, resolver_, address, self_, observer);
  }
  tend_soon_.enable_in(Duration::zero());
}

// --- connections come and go

// For a connection that stands by while another is used. A dssmd that was restarted is here for a
// moment, until its predecessor's connection is found to be dead; if both live on, they are two.
std::string Peers::same_host_warning(const Peer& in_use, const Peer& by) {
  const bool is_same = in_use.link->them()->life == by.link->them()->life;
  if (is_same && in_use.found) return {};  // to be found too is no mistake of the configuration
  const std::string other =
      "'" + (in_use.found ? in_use.link->address() : in_use.link->configured().str()) +
      "', which is in use";
  if (is_same) return "same host as " + other;
  return "has name and machine id of " + other +
         ", but is another dssmd; give each host its own name (key name), and copied PCs their own "
         "machine id (rm /etc/machine-id && systemd-machine-id-setup)";
}

void Peers::on_link_up(PeerConnection& link) {
  Peer& peer = peer_of(link);
  const wire::Greeting& them = *link.them();
  peer.told_down = false;
  peer.warning.clear();
  tend_soon_.enable_in(Duration::zero());
  if (them.host_id == self_.host_id) return on_own_id(peer);
  if (const Peer* other = in_use(them.host_id)) {
    peer.use = Use::standing_by;
    peer.warning = same_host_warning(*other, peer);
    link.keep_alive();
    return decide(peer);
  }
  use(peer);
}

// This very dssmd or one that cannot be told from it. Its connection is left standing without a
// word: one that is closed would be dialed again and again. Only that to our own echo ends, because
// the next address may be that of another PC.
void Peers::on_own_id(Peer& peer) {
  PeerConnection& link = *peer.link;
  const wire::Greeting& them = *link.them();
  const bool is_self = them.life == self_.life;
  if (is_self && peer.found) {
    return link.drop({Errc::conflict, "at '" + link.address() + "' answers this very dssmd"});
  }
  peer.use = is_self ? Use::self : Use::not_usable;
  if (peer.use == Use::not_usable) {
    peer.warning = "the dssmd at '" + link.address() + "' has this host's name '" + self_.host +
                   "' and machine id (host id " + hex(self_.host_id) +
                   "), so neither sees the other's streams; give one of them another name (key "
                   "name), and a copied PC its own machine id (rm /etc/machine-id && "
                   "systemd-machine-id-setup)";
    if (std::exchange(told_twin_, them.life) != them.life) {
      logger_.warning(peer.warning, {.message_id = message_id::kHostRefused});
    }
  }
  decide(peer);
}

// The first connection to that host: its life is the host's.
void Peers::use(Peer& peer) {
  PeerConnection& link = *peer.link;
  const wire::Greeting& them = *link.them();
  peer.use = Use::in_use;
  peer.warning.clear();
  link.keep_alive();
  logger_.notice(describe(link) + " is up", {.peer = them.host, .message_id = message_id::kHostUp});
  if (them.host == self_.host) {
    peer.use = Use::not_usable;
    peer.warning = "the host at '" + link.address() + "' is called '" + self_.host +
                   "' as this one is, so its streams are not shown here; give each host its own "
                   "name (key name)";
    logger_.warning(peer.warning, {.message_id = message_id::kHostRefused});
    return decide(peer);
  }
  const Result<wire::Address> address = wire::Address::parse(link.address());
  catalog_.host_up(them, address ? *address : link.configured());
  link.watch();
}

void Peers::on_link_down(PeerConnection& link, const Error& why, bool attempt) {
  Peer& peer = peer_of(link);
  const Use was = std::exchange(peer.use, Use::none);
  peer.warning.clear();
  tend_soon_.enable_in(Duration::zero());
  if (was == Use::in_use) {
    const wire::HostId id = link.them()->host_id;
    logger_.notice("host '" + link.them()->host + "' is down: " + why.message,
                   {.peer = link.them()->host, .message_id = message_id::kHostDown});
    catalog_.host_down(id, why);
    take_over(id);
  } else if (attempt && !peer.told_down) {
    const std::string whom = peer.found ? "host '" + peer.found->host.name + "' (found by mDNS)"
                                        : "peer '" + link.configured().str() + "'";
    logger_.notice(whom + " is not there, trying on: " + why.message,
                   {.peer = link.configured().str(), .message_id = message_id::kHostDown});
  }
  peer.told_down = true;
  decide(peer);
}

// The connection to host `id` ended: another one to it may be up.
void Peers::take_over(const wire::HostId& id) {
  const auto next = std::find_if(peers_.begin(), peers_.end(), [&](const Peer& peer) {
    return peer.use == Use::standing_by && peer.link->them()->host_id == id;
  });
  if (next == peers_.end()) return;
  use(*next);
  for (Peer& other : peers_) {
    if (other.use != Use::standing_by || other.link->them()->host_id != id) continue;
    other.warning = same_host_warning(*next, other);
  }
}

Result<void> Peers::on_stream_event_untrusted(PeerConnection& link,
                                              const proto::StreamEvent& event) {
  const wire::Greeting& them = *link.them();
  proto::StreamId named = event.stream().id();
  named.set_host(them.host);  // nobody speaks for another host
  Result<StreamId> id = wire::stream_id_untrusted(named);
  if (!id) return std::move(id).error().context("a stream event");
  if (event.removed()) {
    catalog_.stream_removed(them.host_id, *id);
    return {};
  }
  const Result<TypeInfo> type = wire::type_untrusted(event.stream().type());
  if (!type) return Error(type.error()).context("stream '" + id->str() + "'");
  StreamInfo stream = wire::stream_info(event.stream());
  stream.id = *std::move(id);
  stream.users.clear();
  return catalog_.stream_added(them.host_id, std::move(stream));
}

void Peers::on_watched(PeerConnection& link) { decide(peer_of(link)); }

void Peers::on_heartbeat(PeerConnection& link) {
  if (peer_of(link).use != Use::in_use) return;
  catalog_.set_clock(link.them()->host_id, link.them()->clock);
}

// --- the first words

void Peers::decide(Peer& peer) {
  peer.decided = true;
  settle_if_decided();
}

void Peers::settle_if_decided() {
  const auto decided = [](const Peer& each) { return each.found || each.decided; };
  if (settled_ || finder_is_searching_ || !std::all_of(peers_.begin(), peers_.end(), decided)) {
    return;
  }
  settle();
}

void Peers::settle() {
  if (std::exchange(settled_, true)) return;
  settle_timer_.disable();
  if (on_settled_) std::exchange(on_settled_, {})();
}

}  // namespace dssm::daemon
