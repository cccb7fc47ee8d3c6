// SPDX-License-Identifier: Apache-2.0
//
// The configured peers (key peers) as a source of the catalog: one control connection to each, of
// which at most one per host is in use. It is the connection whose life is the host's life: when it
// comes up the host is up, when it breaks or falls silent the host is down, with all its streams.
//
//   a host at two addresses        the second connection stands by and takes over when the first
//   ends this very dssmd                is left alone another PC with this one's id  (a cloned
//   disk, and the same name) is left alone, with a warning two hosts of one name          are both
//   kept; `@name` is then a conflict; a warning a host with our own name       is known, but its
//   streams are not: nothing could tell them from
//                                  our own; a warning
#pragma once

#include <functional>
#include <map>
#include <memory>
#include <string>
#include <vector>

#include "daemon/discovery/catalog.hpp"
#include "daemon/discovery/peer_link.hpp"
#include "daemon/service/event_loop.hpp"
#include "daemon/service/log.hpp"
#include "local.pb.h"

namespace dssm::daemon {

class Peers final : private PeerLink::User {
 public:
  // So long after the start nobody waits any more for peers that were not heard of.
  static constexpr Duration kSettleTime = std::chrono::seconds(1);

  // self: what to say, and how to know oneself. What is given by reference outlives it.
  Peers(const EventLoop& loop, Resolver& resolver, const std::vector<wire::Address>& peers,
        wire::Greeting self, Catalog& catalog, Logger& logger);
  Peers(const Peers&) = delete;
  Peers& operator=(const Peers&) = delete;
  ~Peers();

  // The connection to a host that is up; nullptr: there is none.
  PeerLink* link_to(const wire::HostId& id);

  // Whether the first word of each peer came, good or bad, or kSettleTime passed.
  bool settled() const noexcept { return settled_; }
  // Called once, from the loop, when it settles.
  void on_settled(std::function<void()> then) { on_settled_ = std::move(then); }

  // All peers, in the order of the configuration.
  std::vector<local::Host> hosts() const;
  // What a program may have to know when something is not found: "'pc3:13776' (Connection
  // refused)"; empty: all peers are up.
  std::string trouble() const;
  // A warning that concerns this host itself; empty: none.
  std::string own_trouble() const;

 private:
  // What a connection that is up is good for.
  enum class Use : unsigned char { none, in_use, standing_by, self, not_usable };
  struct Peer {
    std::unique_ptr<PeerLink> link;
    Use use = Use::none;
    bool decided = false;    // its first word came
    bool told_down = false;  // the log says that it is not up
    std::string warning;     // concerns this peer while it is up
  };

  void on_link_up(PeerLink& link) override;
  void on_link_down(PeerLink& link, const Error& why, bool attempt) override;
  Result<void> on_stream_event_untrusted(PeerLink& link, const net::StreamEvent& event) override;
  void on_watched(PeerLink& link) override;
  void on_heartbeat(PeerLink& link) override;

  Peer& peer_of(const PeerLink& link);
  const Peer* in_use(const wire::HostId& id) const;
  void use(Peer& peer);
  void take_over(const wire::HostId& id);
  void decide(Peer& peer);
  void settle();
  std::string namesake_warning(const Peer& peer) const;

  const wire::Greeting self_;
  Catalog& catalog_;
  Logger& logger_;
  std::vector<Peer> peers_;
  bool settled_ = false;
  std::function<void()> on_settled_;
  EventSource settle_timer_;
};

}  // namespace dssm::daemon
