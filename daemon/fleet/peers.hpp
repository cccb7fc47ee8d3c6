// SPDX-License-Identifier: Apache-2.0
//
// Configured peers (key peers) and hosts that mDNS finds, as the two sources of the catalog: a
// control connection to each, of which at most one per host is in use. It is the connection whose
// life is the host's life: when it comes up the host is up, when it breaks or falls silent the host
// is down, with all its streams.
//
//   a host at two configured addresses
//     The second connection stands by and takes over when the first ends.
//   a host that is found
//     One connection, to whichever of its addresses works. None while a configured peer's
//     connection to that host is up; when that one breaks, the found addresses are tried at once
//     beside the configured one, and the first that comes up is used.
//   a host that mDNS does not know any more
//     The connection is the truth: the host is forgotten when that is not up.
//   an announcement with a wrong id
//     Whoever answers there is refused, and while a host is up nobody else is looked for at its
//     address, so that announcements cannot bring up, replace or disturb another host than the one
//     that they name.
//   this very dssmd
//     Is left alone.
//   another PC with this one's id (a cloned disk, and the same name)
//     Is left alone, with a warning. Found ones too are asked who they are: what mDNS tells of our
//     own id may be an echo of our own announcement, which is passed over without a word.
//   two hosts of one name
//     Both are kept; `@name` is then a conflict; a warning.
//   a host with our own name
//     Is known, but its streams are not: nothing could tell them from our own; a warning.
#pragma once

#include <functional>
#include <list>
#include <map>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "daemon/base/event_loop.hpp"
#include "daemon/base/log.hpp"
#include "daemon/base/rate_limited_logger.hpp"
#include "daemon/fleet/catalog.hpp"
#include "daemon/fleet/found_host.hpp"
#include "daemon/fleet/peer_connection.hpp"
#include "local.pb.h"

namespace dssm::daemon {

class Peers final : public HostFinderObserver, private PeerConnection::Observer {
 public:
  // So long after the start nobody waits any more for peers that were not heard of.
  static constexpr Duration kSettleTime = std::chrono::seconds(1);
  // What mDNS may have us follow: anybody on the network can announce hosts.
  static constexpr std::size_t kMaxFoundHosts = 256;
  static constexpr std::size_t kMaxAddressesOfHost = 16;

  // self: what to say, and how to know oneself. What is given by reference outlives it.
  Peers(const EventLoop& loop, Resolver& resolver, const std::vector<wire::Address>& peers,
        wire::Greeting self, Catalog& catalog, Logger& logger);
  Peers(const Peers&) = delete;
  Peers& operator=(const Peers&) = delete;
  ~Peers();

  // Takes these configured peers in place of those before: new ones are dialed, those that are not
  // among them any more are dropped. To be called from the loop.
  void set_configured(const std::vector<wire::Address>& peers);

  // Called from the loop after changes, several of them together; {}: nobody.
  void on_change(std::function<void()> then) { on_change_ = std::move(then); }

  // There is a finder, which will call the functions below. To be called before the loop runs.
  //   insecure  found hosts may be reached over the network, in the clear; else only those on this
  //             PC's loopback
  void expect_finder(bool insecure);
  void on_host_found(const FoundHost& host) override;
  void on_host_lost(const wire::HostId& id) override;
  void on_mdns_state(const MdnsState& state) override;
  // How the finder fares; off: there is none.
  const MdnsState& mdns() const noexcept { return mdns_; }

  // The connection to a host that is up; nullptr: there is none.
  PeerConnection* link_to(const wire::HostId& id);

  // Whether kSettleTime passed, or the first word of each configured peer came, good or bad, and
  // there is no finder that might still find others: mDNS has no end, so when it works the time is
  // waited for, and when there is no Avahi nobody waits for it.
  bool settled() const noexcept { return settled_; }
  // Called once, from the loop, when it settles.
  void on_settled(std::function<void()> then) { on_settled_ = std::move(then); }

  // All configured peers, in the order of the configuration, then the found hosts that none of
  // their connections stands for.
  std::vector<local::Host> hosts() const;
  // What a program may have to know when something is not found: "'pc3:13776' (Connection
  // refused)"; empty: all peers are up.
  std::string trouble() const;
  // A warning that concerns this host itself; empty: none.
  std::string own_warning() const;

 private:
  // What a connection that is up is good for.
  enum class Use : unsigned char { none, in_use, standing_by, self, not_usable };
  // Why a found host is not dialed, as the list of hosts tells it.
  struct Obstacle {
    std::string state;
    std::string error;
  };
  struct Found {
    FoundHost host;
    bool listed = true;  // mDNS still knows it
    MonoTime since;
    std::vector<wire::Address> usable;  // of its addresses
    std::optional<Obstacle> obstacle;
  };
  struct Peer {
    std::optional<Found> found;            // else it is configured
    std::unique_ptr<PeerConnection> link;  // nullptr: a found host that is not dialed
    Use use = Use::none;
    bool decided = false;    // its first word came
    bool told_down = false;  // the log says that it is not up
    bool leaving = false;    // is not configured any more
    std::string warning;     // concerns this peer while it is up
  };
  // Addresses, written as numbers, and who answers there at this moment.
  using Occupied = std::map<std::string, const wire::Greeting*>;

  void on_link_up(PeerConnection& link) override;
  void on_link_down(PeerConnection& link, const Error& why, bool attempt) override;
  Result<void> on_stream_event_untrusted(PeerConnection& link,
                                         const proto::StreamEvent& event) override;
  void on_watched(PeerConnection& link) override;
  void on_heartbeat(PeerConnection& link) override;

  Peer& peer_of(const PeerConnection& link);
  Peer* found_host(const wire::HostId& id);
  const Peer* in_use(const wire::HostId& id) const;
  bool is_up_as_configured(const wire::HostId& id) const;
  void on_own_id(Peer& peer);
  void use(Peer& peer);
  void take_over(const wire::HostId& id);
  void tend();
  void tend_found_host(std::list<Peer>::iterator peer, const Occupied& now_occupied);
  void look_at(Found& found, const Occupied& occupied) const;
  Occupied occupied() const;
  void decide(Peer& peer);
  void settle_if_decided();
  void settle();

  static std::string same_host_warning(const Peer& in_use, const Peer& by);
  std::string namesake_warning(const Peer& peer) const;
  bool is_shown(const Peer& peer) const;
  bool is_shown_by_configured(const Peer& found) const;
  bool shows_use(const Peer& peer) const;
  local::Host shown(const Peer& peer) const;

  const EventLoop& loop_;
  Resolver& resolver_;
  const wire::Greeting self_;
  Catalog& catalog_;
  RateLimitedLogger logger_;  // found hosts come and go as whoever announces them likes
  std::list<Peer> peers_;     // the configured ones first
  bool insecure_ = false;
  bool told_too_many_ = false;
  std::uint64_t told_twin_ = 0;  // the life of the one with our id of which the log knows
  MdnsState mdns_;
  bool finder_is_searching_ = false;
  bool settled_ = false;
  std::function<void()> on_settled_, on_change_;
  EventSource settle_timer_;
  // Connections end, and those to found hosts begin, only here: never within a call of another
  // one's.
  EventSource tend_soon_;
};

}  // namespace dssm::daemon
