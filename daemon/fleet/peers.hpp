// SPDX-License-Identifier: Apache-2.0
//
// Configured peers (key peers) and hosts that mDNS finds, as the two sources of the catalog: a
// control connection to each, of which at most one per host is in use. While that connection is up,
// the host is up; when it ends, the host is down, and its streams leave the catalog.
//
// Which code decides that a host is dead:
//
//   PeerConnection::beat()      once a second: no byte came for 2.8 s (wire::kPeerTimeout), or,
//                               while output waits for the peer's kernel to take it, for 28 s
//                               (kPeerTimeoutWithOutput): a large property on a slow network delays
//                               our own heartbeats. Then it closes the connection. (Our kernel
//                               detects earlier that the peer's PC is off: TCP_USER_TIMEOUT.)
//   Peers::on_peer_down()       the host is down, by this or because the connection broke:
//                               another connection to it takes over, else
//                               Catalog::host_down() removes it, and mirrors and remote writers, as
//                               observers of the catalog, end their channels to it
//
//   a host at two configured addresses
//     The second connection stands by and takes over when the first ends.
//   a host that is found
//     One connection, to whichever of its addresses works. None while a configured peer's
//     connection to that host is up; when that one breaks, the found addresses are tried at once
//     beside the configured one, and the first that comes up is used.
//   a host that mDNS does not know any more
//     The connection decides: the host is removed when it is not up.
//   an announcement with a wrong id
//     Any other host that answers there is refused, and while a host is up no other one is dialed
//     at its address, so that announcements cannot bring up, replace or disturb another host than
//     the one that they name.
//   this very dssmd
//     Is connected to and not used.
//   a duplicate: another dssmd with this host's id (a cloned disk, and the same name)
//     Is connected to and not used, with a warning. Found ones are asked for their instance id,
//     too: what mDNS finds with our own id may be an echo of our own announcement, which is
//     ignored.
//   namesakes: two hosts of one name
//     Both are kept; `@name` is then a conflict; a warning.
//   a namesake of this host
//     Is known, but its streams are not: they could not be distinguished from our own; a warning.
#pragma once

#include <functional>
#include <list>
#include <map>
#include <memory>
#include <string>
#include <vector>

#include "daemon/base/event_loop.hpp"
#include "daemon/base/log.hpp"
#include "daemon/fleet/catalog.hpp"
#include "daemon/fleet/peer.hpp"
#include "daemon/fleet/service_record.hpp"

namespace dssm::daemon {

class Peers final : public HostFinderObserver, private PeerConnection::Observer {
 public:
  // How long requests wait at most, after the start, for peers that were not tried yet.
  static constexpr Duration kStartupTime = std::chrono::seconds(1);
  // Limits for mDNS: any PC on the network can announce hosts.
  static constexpr std::size_t kMaxFoundHosts = 256;
  static constexpr std::size_t kMaxAddressesOfHost = 16;

  // self: the greeting, by which this host recognizes itself. What is given by reference outlives
  // it.
  //   handshakes  as in Dialer::Options
  Peers(const EventLoop& loop, Resolver& resolver, const std::vector<wire::Address>& peers,
        wire::Greeting self, Catalog& catalog, Logger& logger,
        HandshakeBudget* handshakes = nullptr);
  Peers(const Peers&) = delete;
  Peers& operator=(const Peers&) = delete;
  ~Peers();

  // Replaces the configured peers: new ones are dialed, those that are no longer configured are
  // dropped. To be called from the loop.
  void set_configured(const std::vector<wire::Address>& peers);
  // This PC's network may have come back: all that are not up are tried now. From the loop.
  void on_network_changed();
  // The own credentials were replaced. From the loop.
  void on_new_credentials();

  // Called from the loop after changes, several of them together; {}: no callback.
  void on_change(std::function<void()> then) { on_change_ = std::move(then); }

  // There is a finder, which will call the functions below. To be called before the loop runs.
  //   leaves_pc  found hosts may be reached over the network; else only those on this PC's loopback
  void expect_finder(bool leaves_pc);
  void on_host_found(const FoundHost& host) override;
  void on_host_lost(const wire::HostId& id) override;
  void on_mdns_state(const MdnsInfo& state) override;
  // How the finder fares; off: there is none.
  const MdnsInfo& mdns() const noexcept { return mdns_; }

  // Whether a connection comes from a configured peer: from its address, or with the certificate of
  // the host that answers there, or did last.
  bool is_configured(const wire::SocketAddress& from, const wire::CertifiedPeer* certified) const;

  // The connection to a host that is up; nullptr: there is none.
  PeerConnection* connection_to(const wire::HostId& id);

  // Whether kStartupTime passed, or each configured peer was tried and there is no finder that
  // might still find others: mDNS has no end, so while it works the time is waited for; without an
  // Avahi daemon it is not.
  bool startup_is_over() const noexcept { return startup_is_over_; }
  // Called once, from the loop.
  void on_startup_over(std::function<void()> then) { on_startup_over_ = std::move(then); }

  // To be used at once.
  PeerReport report() const { return {peers_, self_.host_id, catalog_, loop_.now()}; }

 private:
  // Addresses, written as numbers, and which host answers there now: its id and its name.
  using Occupied = std::map<std::string, std::pair<wire::HostId, std::string>>;

  void on_peer_up(PeerConnection& connection) override;
  void on_peer_down(PeerConnection& connection, const Error& error, bool attempt) override;
  Result<void> on_stream_event_untrusted(PeerConnection& connection,
                                         const proto::StreamEvent& event) override;
  void on_watched(PeerConnection& connection) override;
  void on_heartbeat(PeerConnection& connection) override;

  Peer& peer_of(const PeerConnection& connection);
  Peer* found_host(const wire::HostId& id);
  const Peer* in_use(const wire::HostId& id) const;
  bool is_up_as_configured(const wire::HostId& id) const;
  void on_own_id(Peer& peer);
  void start_use(Peer& peer);
  void take_over(const wire::HostId& id);
  std::unique_ptr<PeerConnection> dial(const wire::Address& configured);

  void reconcile_soon() { reconcile_soon_.enable_in(Duration::zero()); }
  void reconcile();
  void reconcile_found_host(std::list<Peer>::iterator peer, const Occupied& now_occupied);
  void find_usable_addresses(Peer::Found& found, const Occupied& occupied) const;
  Occupied occupied() const;

  void set_tried(Peer& peer);
  void end_startup_if_all_tried();
  void end_startup();

  const EventLoop& loop_;
  Resolver& resolver_;
  const wire::Greeting self_;
  HandshakeBudget* const handshakes_;
  Catalog& catalog_;
  RateLimitedLogger logger_;  // how often found hosts change is decided by their announcements
  std::list<Peer> peers_;     // the configured ones first
  bool leaves_pc_ = false;
  bool logged_too_many_ = false;
  std::uint64_t logged_duplicate_ = 0;  // instance id of the duplicate that the log names
  MdnsInfo mdns_;
  bool finder_is_searching_ = false;
  bool startup_is_over_ = false;
  std::function<void()> on_startup_over_, on_change_;
  EventSource startup_timer_;
  // Connections end, and those to found hosts begin, only in reconcile(): never within a call of
  // another one.
  EventSource reconcile_soon_;
  EventSource report_removed_;  // of many streams of hosts that are down
};

}  // namespace dssm::daemon
