// SPDX-License-Identifier: Apache-2.0
#include "daemon/fleet/peers.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <utility>

#include "core/base/text.hpp"
#include "core/base/try.hpp"
#include "daemon/base/message_ids.hpp"
#include "daemon/fleet/service_record.hpp"

namespace dssm::daemon {
namespace {

std::string describe(const PeerConnection& connection) {
  return fmt::format("host '{}' ('{}')", connection.them()->host, connection.address());
}

// For a connection that stands by while another is used. A dssmd that was restarted stands by until
// the connection to its predecessor times out; if both stay, they are two.
PeerProblem same_host_warning(const Peer& in_use, const Peer& by) {
  const bool is_same = in_use.them().instance_id == by.them().instance_id;
  if (is_same && !in_use.is_configured()) return {};  // configured and found: as it should be
  const std::string other =
      in_use.is_configured() ? in_use.connection->configured().str() : in_use.connection->address();
  if (is_same) {
    return {HostReason::spare_address, fmt::format("same host as '{}', which is in use", other)};
  }
  return {
      HostReason::duplicate,
      fmt::format("has name and machine id of '{}', which is in use, but is another dssmd; give "
                  "each host its own name (key name), and copied PCs their own machine id (rm "
                  "/etc/machine-id && systemd-machine-id-setup)",
                  other)};
}

}  // namespace

Peers::Peers(const EventLoop& loop, Resolver& resolver, const std::vector<wire::Address>& peers,
             wire::Greeting self, Catalog& catalog, Logger& logger, HandshakeBudget* handshakes)
    : loop_(loop),
      resolver_(resolver),
      self_(std::move(self)),
      handshakes_(handshakes),
      catalog_(catalog),
      logger_(logger),
      startup_is_over_(peers.empty()),
      startup_timer_(EventSource::timer(loop, [this] { end_startup(); })),
      reconcile_soon_(EventSource::timer(loop, [this] { reconcile(); })),
      report_removed_(EventSource::timer(loop, [this] {
        if (catalog_.report_removed()) report_removed_.enable_in(Duration::zero());
      })) {
  if (!startup_is_over_) startup_timer_.enable_in(kStartupTime);
  for (const wire::Address& peer : peers) peers_.emplace_back().connection = dial(peer);
}

Peers::~Peers() = default;

std::unique_ptr<PeerConnection> Peers::dial(const wire::Address& configured) {
  PeerConnection::Observer& observer = *this;
  return std::make_unique<PeerConnection>(loop_, resolver_, configured, self_, handshakes_,
                                          observer);
}

Peer& Peers::peer_of(const PeerConnection& connection) {
  return *std::find_if(peers_.begin(), peers_.end(),
                       [&](const Peer& peer) { return peer.connection.get() == &connection; });
}

Peer* Peers::found_host(const wire::HostId& id) {
  const auto found = std::find_if(peers_.begin(), peers_.end(), [&](const Peer& peer) {
    return peer.found && peer.found->host.id == id;
  });
  return found == peers_.end() ? nullptr : &*found;
}

const Peer* Peers::in_use(const wire::HostId& id) const {
  const auto found = std::find_if(peers_.begin(), peers_.end(), [&](const Peer& peer) {
    return peer.use == PeerUse::in_use && peer.them().host_id == id;
  });
  return found == peers_.end() ? nullptr : &*found;
}

bool Peers::is_up_as_configured(const wire::HostId& id) const {
  return std::any_of(peers_.begin(), peers_.end(), [&](const Peer& peer) {
    return peer.is_configured() && peer.is_up() && peer.use != PeerUse::self &&
           peer.them().host_id == id;
  });
}

bool Peers::is_configured(const wire::SocketAddress& from,
                          const wire::CertifiedPeer* certified) const {
  const std::optional<wire::IpAddress> address = wire::IpAddress::of(from);
  const bool is_host = certified && certified->kind == wire::CertifiedPeer::Kind::host;
  return std::any_of(peers_.begin(), peers_.end(), [&](const Peer& peer) {
    if (!peer.is_configured()) return false;
    const std::optional<wire::Greeting>& them = peer.connection->them();
    return (address && peer.connection->is_at(*address)) ||
           (is_host && them && them->host_id == certified->host_id);
  });
}

PeerConnection* Peers::connection_to(const wire::HostId& id) {
  const Peer* peer = in_use(id);
  return peer ? peer->connection.get() : nullptr;
}

// --- found hosts

void Peers::expect_finder(bool leaves_pc) {
  leaves_pc_ = leaves_pc;
  mdns_.phase = MdnsPhase::waiting;
  finder_is_searching_ = true;
  startup_is_over_ = false;
  startup_timer_.enable_in(kStartupTime);
}

void Peers::on_host_found(const FoundHost& host) {
  Peer* known = found_host(host.id);
  if (!known) {
    const auto count = std::count_if(peers_.begin(), peers_.end(),
                                     [](const Peer& peer) { return peer.found.has_value(); });
    if (static_cast<std::size_t>(count) >= kMaxFoundHosts) {
      if (std::exchange(logged_too_many_, true)) return;
      return logger_.warning(
          fmt::format("mDNS finds more than {} hosts; further ones, such as '{}', are ignored (add "
                      "those that are needed to the key peers; `avahi-browse -r _dssm._tcp` shows "
                      "which PCs announce them)",
                      kMaxFoundHosts, host.name),
          {.peer = host.name, .message_id = message_id::kHostRefused});
    }
    known = &peers_.emplace_back();
    known->found = Peer::Found{};
    known->found->since = loop_.now();
  }
  known->found->listed = true;
  known->found->host = host;
  if (host.addresses.size() > kMaxAddressesOfHost) {
    known->found->host.addresses.resize(kMaxAddressesOfHost);
  }
  reconcile_soon();
}

void Peers::on_host_lost(const wire::HostId& id) {
  Peer* known = found_host(id);
  if (!known) return;
  known->found->listed = false;
  reconcile_soon();
}

void Peers::on_mdns_state(const MdnsInfo& state) {
  mdns_ = state;
  finder_is_searching_ = state.phase == MdnsPhase::running;
  end_startup_if_all_tried();
}

Peers::Occupied Peers::occupied() const {
  Occupied occupied;
  for (const Peer& peer : peers_) {
    if (!peer.is_up()) continue;
    occupied.emplace(peer.connection->address(), std::pair(peer.them().host_id, peer.them().host));
  }
  return occupied;
}

// Decides which addresses a connection to that host may use; when there are none, the obstacle.
void Peers::find_usable_addresses(Peer::Found& found, const Occupied& occupied) const {
  const FoundHost& host = found.host;
  const std::string who = "host '" + host.name + "'";
  PeerProblem& obstacle = found.obstacle;
  found.usable.clear();
  if (host.protocol_version != wire::kNetworkProtocolVersion) {
    obstacle = {HostReason::not_accepted,
                wire::other_protocol_version("dssmd of " + who, host.protocol_version).message};
    return;
  }
  if (host.closed) {
    obstacle = {HostReason::closed_there,
                who +
                    " listens on its own loopback only; to share its streams set listen and "
                    "credentials there, see docs/security.md"};
  } else {
    obstacle = {HostReason::no_address,
                who +
                    " is announced without an address that can be reached from here; check the "
                    "network interfaces of both"};
  }
  for (const wire::Address& address : host.addresses) {
    const std::vector<wire::SocketAddress> numbers = wire::resolve_number(address);
    if (numbers.empty()) continue;
    if (!leaves_pc_ && !numbers.front().is_loopback()) {
      obstacle = {HostReason::closed_here,
                  who +
                      " is on another PC, and this dssmd has no credentials to connect to others, "
                      "see docs/security.md"};
      continue;
    }
    const auto occupant = occupied.find(numbers.front().str());
    if (occupant != occupied.end() && occupant->second.first != host.id) {
      obstacle = {HostReason::not_accepted,
                  fmt::format("{} is announced at '{}', where host '{}' answers", who,
                              address.str(), occupant->second.second)};
      continue;
    }
    found.usable.push_back(address);
  }
  if (!found.usable.empty()) {
    obstacle = {};
  } else if (host.id == self_.host_id) {
    if (obstacle.reason == HostReason::not_accepted) obstacle.reason = HostReason::duplicate;
    obstacle.text = fmt::format(
        "another dssmd is announced with this host's name '{}' and machine id, but cannot be asked "
        "for its instance id: {}",
        self_.host, obstacle.text);
  }
}

void Peers::reconcile() {
  const Occupied now_occupied = occupied();
  for (auto next = peers_.begin(); next != peers_.end();) {
    const auto peer = next++;
    if (!peer->is_configured()) {
      reconcile_found_host(peer, now_occupied);
    } else if (peer->leaving && !peer->is_up()) {
      peers_.erase(peer);
    }
  }
  end_startup_if_all_tried();
  if (on_change_) on_change_();
}

// May erase `peer`.
void Peers::reconcile_found_host(std::list<Peer>::iterator peer, const Occupied& now_occupied) {
  PeerConnection::Observer& observer = *this;
  Peer::Found& found = *peer->found;
  const std::vector<wire::Address> before = found.usable;
  find_usable_addresses(found, now_occupied);
  const bool is_needed = !is_up_as_configured(found.host.id);
  const bool is_up = peer->use == PeerUse::in_use || (peer->is_up() && is_needed);
  if (!found.listed && !is_up) {
    peers_.erase(peer);
  } else if (!is_up && (!is_needed || found.usable.empty())) {
    peer->connection.reset();
    peer->use = PeerUse::none;
    peer->warning = {};
  } else if (!peer->connection) {
    peer->connection = std::make_unique<PeerConnection>(loop_, resolver_, found.host.id,
                                                        found.usable, self_, handshakes_, observer);
  } else if (!found.usable.empty() && found.usable != before) {
    peer->connection->set_addresses(found.usable);
  }
}

// --- configured peers change

void Peers::set_configured(const std::vector<wire::Address>& peers) {
  std::vector<wire::Address> known;
  for (Peer& peer : peers_) {
    if (!peer.is_configured() || peer.leaving) continue;
    const wire::Address& address = peer.connection->configured();
    known.push_back(address);
    if (std::find(peers.begin(), peers.end(), address) != peers.end()) continue;
    peer.leaving = true;
    // Requests that wait for its answers fail; reconcile() removes it when the connection has
    // ended.
    peer.connection->drop({Errc::unavailable, "it is no longer among the peers (key peers)"});
  }
  const auto first_found = std::find_if(peers_.begin(), peers_.end(),
                                        [](const Peer& peer) { return !peer.is_configured(); });
  for (const wire::Address& address : peers) {
    if (std::find(known.begin(), known.end(), address) != known.end()) continue;
    peers_.emplace(first_found)->connection = dial(address);
  }
  reconcile_soon();
}

void Peers::on_network_changed() {
  for (const Peer& peer : peers_) {
    if (peer.connection) peer.connection->on_network_changed();
  }
}

void Peers::on_new_credentials() {
  for (const Peer& peer : peers_) {
    if (peer.connection) peer.connection->on_new_credentials();
  }
}

// --- connections begin and end

void Peers::on_peer_up(PeerConnection& connection) {
  Peer& peer = peer_of(connection);
  const wire::Greeting& them = *connection.them();
  peer.logged_down = false;
  peer.warning = {};
  reconcile_soon();
  if (them.host_id == self_.host_id) return on_own_id(peer);
  if (const Peer* other = in_use(them.host_id)) {
    peer.use = PeerUse::standing_by;
    peer.warning = same_host_warning(*other, peer);
    connection.start_heartbeat();
    return set_tried(peer);
  }
  start_use(peer);
}

// This very dssmd or its duplicate. Its connection stays open: it would be dialed again if it were
// closed. Only a connection to this dssmd that mDNS suggested ends, because the next address may be
// another PC's.
void Peers::on_own_id(Peer& peer) {
  PeerConnection& connection = *peer.connection;
  const wire::Greeting& them = *connection.them();
  const bool is_self = them.instance_id == self_.instance_id;
  if (is_self && peer.found) {
    return connection.drop(
        {Errc::conflict, fmt::format("this very dssmd answers at '{}'", connection.address())});
  }
  peer.use = is_self ? PeerUse::self : PeerUse::refused;
  if (peer.use == PeerUse::refused) {
    peer.warning = {
        HostReason::duplicate,
        fmt::format("the dssmd at '{}' has this host's name '{}' and machine id (host id {}), so "
                    "neither sees the other's streams; give one of them another name (key name), "
                    "and a copied PC its own machine id (rm /etc/machine-id && "
                    "systemd-machine-id-setup)",
                    connection.address(), self_.host, hex(self_.host_id))};
    if (std::exchange(logged_duplicate_, them.instance_id) != them.instance_id) {
      logger_.warning(peer.warning.text, {.message_id = message_id::kHostRefused});
    }
  }
  set_tried(peer);
}

// The first connection to that host: the host is up.
void Peers::start_use(Peer& peer) {
  PeerConnection& connection = *peer.connection;
  const wire::Greeting& them = *connection.them();
  peer.use = PeerUse::in_use;
  peer.warning = {};
  connection.start_heartbeat();
  logger_.notice(describe(connection) + " is up",
                 {.peer = them.host, .message_id = message_id::kHostUp});
  if (them.host == self_.host) {
    peer.use = PeerUse::refused;
    peer.warning = {
        HostReason::namesake,
        fmt::format("the host at '{}' is called '{}' as this one is, so its streams are not shown "
                    "here; give each host its own name (key name)",
                    connection.address(), self_.host)};
    logger_.warning(peer.warning.text, {.message_id = message_id::kHostRefused});
    return set_tried(peer);
  }
  const Result<wire::Address> address = wire::Address::parse(connection.address());
  catalog_.host_up(them, address ? *address : connection.configured());
  report_removed_.enable_in(Duration::zero());
  connection.watch();
}

void Peers::on_peer_down(PeerConnection& connection, const Error& error, bool attempt) {
  Peer& peer = peer_of(connection);
  const PeerUse was = std::exchange(peer.use, PeerUse::none);
  peer.warning = {};
  reconcile_soon();
  if (was == PeerUse::in_use) {
    const wire::HostId id = connection.them()->host_id;
    logger_.notice(fmt::format("host '{}' is down: {}", connection.them()->host, error.message),
                   {.peer = connection.them()->host, .message_id = message_id::kHostDown});
    catalog_.host_down(id, error);
    report_removed_.enable_in(Duration::zero());
    take_over(id);
  } else if (attempt && !peer.logged_down) {
    const std::string who = peer.is_configured()
                                ? fmt::format("peer '{}'", connection.configured().str())
                                : fmt::format("host '{}' (found by mDNS)", peer.found->host.name);
    logger_.notice(fmt::format("{} is not available, retrying: {}", who, error.message),
                   {.peer = connection.configured().str(), .message_id = message_id::kHostDown});
  }
  peer.logged_down = true;
  set_tried(peer);
}

// The connection to host `id` ended: another one to it may be up.
void Peers::take_over(const wire::HostId& id) {
  const auto next = std::find_if(peers_.begin(), peers_.end(), [&](const Peer& peer) {
    return peer.use == PeerUse::standing_by && peer.them().host_id == id;
  });
  if (next == peers_.end()) return;
  start_use(*next);
  for (Peer& other : peers_) {
    if (other.use != PeerUse::standing_by || other.them().host_id != id) continue;
    other.warning = same_host_warning(*next, other);
  }
}

Result<void> Peers::on_stream_event_untrusted(PeerConnection& connection,
                                              const proto::StreamEvent& event) {
  const wire::Greeting& them = *connection.them();
  proto::StreamId named = event.stream().id();
  named.set_host(them.host);  // a host describes only its own streams
  StreamId id = DSSM_TRY(wire::stream_id_untrusted(named), "a stream event");
  if (event.removed()) {
    catalog_.stream_removed(them.host_id, id);
    return {};
  }
  DSSM_TRY(wire::type_untrusted(event.stream().type()), "stream '" + id.str() + "'");
  StreamInfo stream = wire::stream_info(event.stream());
  stream.id = std::move(id);
  stream.users.clear();
  return catalog_.stream_added(them.host_id, std::move(stream), event.property_set());
}

void Peers::on_watched(PeerConnection& connection) { set_tried(peer_of(connection)); }

void Peers::on_heartbeat(PeerConnection& connection) {
  if (peer_of(connection).use != PeerUse::in_use) return;
  catalog_.set_clock(connection.them()->host_id, connection.them()->clock);
}

// --- startup

void Peers::set_tried(Peer& peer) {
  peer.tried = true;
  end_startup_if_all_tried();
}

void Peers::end_startup_if_all_tried() {
  const auto tried = [](const Peer& each) { return !each.is_configured() || each.tried; };
  if (startup_is_over_ || finder_is_searching_ ||
      !std::all_of(peers_.begin(), peers_.end(), tried)) {
    return;
  }
  end_startup();
}

void Peers::end_startup() {
  if (std::exchange(startup_is_over_, true)) return;
  startup_timer_.disable();
  if (on_startup_over_) std::exchange(on_startup_over_, {})();
}

}  // namespace dssm::daemon
