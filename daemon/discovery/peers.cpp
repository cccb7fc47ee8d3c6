// SPDX-License-Identifier: Apache-2.0
#include "daemon/discovery/peers.hpp"

#include <algorithm>
#include <utility>

#include "daemon/service/message_ids.hpp"

namespace dssm::daemon {
namespace {

std::string describe(const PeerLink& link) {
  return "host '" + link.them()->host + "' ('" + link.address() + "')";
}

// For a connection that stands by while `in_use` is used. A dssmd that was restarted is here for a
// moment, until its predecessor's connection is found to be dead; if both live on, they are two.
std::string same_host_warning(const PeerLink& in_use, const PeerLink& by) {
  const std::string other = "'" + in_use.configured().str() + "', which is in use";
  if (in_use.them()->life == by.them()->life) return "same host as " + other;
  return "has name and machine id of " + other +
         ", but is another dssmd; give each host its own name (key name), and copied PCs their own "
         "/etc/machine-id";
}

}  // namespace

Peers::Peers(const EventLoop& loop, Resolver& resolver, const std::vector<wire::Address>& peers,
             wire::Greeting self, Catalog& catalog, Logger& logger)
    : self_(std::move(self)),
      catalog_(catalog),
      logger_(logger),
      settled_(peers.empty()),
      settle_timer_(EventSource::timer(loop, [this] { settle(); })) {
  if (!settled_) settle_timer_.enable_in(kSettleTime);
  PeerLink::User& user = *this;
  for (const wire::Address& peer : peers) {
    peers_.emplace_back().link = std::make_unique<PeerLink>(loop, resolver, peer, self_, user);
  }
}

Peers::~Peers() = default;

Peers::Peer& Peers::peer_of(const PeerLink& link) {
  return *std::find_if(peers_.begin(), peers_.end(),
                       [&](const Peer& peer) { return peer.link.get() == &link; });
}

const Peers::Peer* Peers::in_use(const wire::HostId& id) const {
  const auto found = std::find_if(peers_.begin(), peers_.end(), [&](const Peer& peer) {
    return peer.use == Use::in_use && peer.link->them()->host_id == id;
  });
  return found == peers_.end() ? nullptr : &*found;
}

PeerLink* Peers::link_to(const wire::HostId& id) {
  const Peer* peer = in_use(id);
  return peer ? peer->link.get() : nullptr;
}

// --- connections come and go
// ----------------------------------------------------------------------

void Peers::on_link_up(PeerLink& link) {
  Peer& peer = peer_of(link);
  const wire::Greeting& them = *link.them();
  peer.told_down = false;
  peer.warning.clear();
  if (them.host_id == self_.host_id) {
    // Left standing without a word: a connection that is closed would be dialed again and again.
    peer.use = them.life == self_.life ? Use::self : Use::not_usable;
    if (peer.use == Use::not_usable) {
      peer.warning = "the dssmd at '" + link.address() + "' has this host's name '" + self_.host +
                     "' and machine id; give each host its own name (key name), and copied PCs "
                     "their own /etc/machine-id";
      logger_.warning(peer.warning, {.message_id = message_id::kHostRefused});
    }
    return decide(peer);
  }
  if (const Peer* other = in_use(them.host_id)) {
    peer.use = Use::standing_by;
    peer.warning = same_host_warning(*other->link, link);
    link.keep_alive();
    return decide(peer);
  }
  use(peer);
}

// The first connection to that host: its life is the host's.
void Peers::use(Peer& peer) {
  PeerLink& link = *peer.link;
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

void Peers::on_link_down(PeerLink& link, const Error& why, bool attempt) {
  Peer& peer = peer_of(link);
  const Use was = std::exchange(peer.use, Use::none);
  peer.warning.clear();
  if (was == Use::in_use) {
    const wire::HostId id = link.them()->host_id;
    logger_.notice("host '" + link.them()->host + "' is down: " + why.message,
                   {.peer = link.them()->host, .message_id = message_id::kHostDown});
    catalog_.host_down(id, why);
    take_over(id);
  } else if (attempt && !peer.told_down) {
    logger_.notice("peer '" + link.configured().str() + "' is not there, trying on: " + why.message,
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
    other.warning = same_host_warning(*next->link, *other.link);
  }
}

Result<void> Peers::on_stream_event_untrusted(PeerLink& link, const net::StreamEvent& event) {
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

void Peers::on_watched(PeerLink& link) { decide(peer_of(link)); }

void Peers::on_heartbeat(PeerLink& link) {
  if (peer_of(link).use != Use::in_use) return;
  catalog_.set_clock_bound(link.them()->host_id, link.them()->clock_bound);
}

// --- the first words
// ------------------------------------------------------------------------------

void Peers::decide(Peer& peer) {
  peer.decided = true;
  const auto decided = [](const Peer& each) { return each.decided; };
  if (!settled_ && std::all_of(peers_.begin(), peers_.end(), decided)) settle();
}

void Peers::settle() {
  if (std::exchange(settled_, true)) return;
  settle_timer_.disable();
  if (on_settled_) std::exchange(on_settled_, {})();
}

// --- what to tell people
// --------------------------------------------------------------------------

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

std::vector<local::Host> Peers::hosts() const {
  std::vector<local::Host> hosts;
  for (const Peer& peer : peers_) {
    const PeerLink& link = *peer.link;
    local::Host& host = hosts.emplace_back();
    host.set_state(peer.use == Use::self         ? "self"
                   : peer.use == Use::not_usable ? "refused"
                                                 : std::string(state_name(link.state())));
    host.add_addresses(link.configured().str());
    if (link.address() != link.configured().str()) host.add_addresses(link.address());
    host.set_since_ns(to_ns(link.in_this_state_for()));
    host.set_round_trip_ns(to_ns(link.last_round_trip()));
    host.set_least_round_trip_ns(to_ns(link.least_round_trip()));
    host.set_clock_bound_ns(to_ns(kUnknownClockError));
    host.set_insecure(link.crosses_network());
    if (link.them()) {
      host.set_name(link.them()->host);
      host.set_host_id(link.them()->host_id.data(), link.them()->host_id.size());
      host.set_version(link.them()->version);
    }
    if (link.why()) host.set_error(link.why()->message);
    if (!peer.warning.empty()) host.set_error(peer.warning);
    if (peer.use != Use::in_use) continue;
    host.set_clock_bound_ns(to_ns(link.them()->clock_bound));
    if (const KnownHost* known = catalog_.find(link.them()->host_id)) {
      host.set_streams(static_cast<std::uint32_t>(known->streams.size()));
    }
    if (std::string warning = namesake_warning(peer); !warning.empty()) {
      host.set_error(std::move(warning));
    }
  }
  return hosts;
}

std::string Peers::trouble() const {
  std::string text;
  for (const Peer& peer : peers_) {
    if (!peer.link->why()) continue;
    text += (text.empty() ? "'" : ", '") + peer.link->configured().str() + "' (" +
            peer.link->why()->message + ")";
  }
  return text;
}

std::string Peers::own_trouble() const {
  for (const Peer& peer : peers_) {
    if (peer.use == Use::not_usable) return peer.warning;
  }
  return {};
}

}  // namespace dssm::daemon
