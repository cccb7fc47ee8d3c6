// SPDX-License-Identifier: Apache-2.0
//
// Fleet for a dssmd with a network: finds owners in the catalog, asks them over their control
// connections, opens mirrors and remote writers, and passes on what changes.
//
// Right after its start dssmd knows no other host yet. A request that would fail for that reason
// waits until each peer has been heard of or tried once (Peers::kStartupTime at most): programs
// that start together with dssmd find remote streams as they find local ones.
#pragma once

#include <deque>
#include <functional>
#include <map>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "daemon/base/event_loop.hpp"
#include "daemon/clock/fleet_clock.hpp"
#include "daemon/fleet/catalog.hpp"
#include "daemon/fleet/peers.hpp"
#include "daemon/fleet/service_record.hpp"
#include "daemon/local/local_requests.hpp"
#include "daemon/remote/mirror.hpp"
#include "daemon/remote/remote_streams.hpp"
#include "daemon/remote/remote_writer.hpp"
#include "daemon/streams/registry.hpp"

namespace dssm::daemon {

class FleetService final : public Fleet, private CatalogObserver {
 public:
  // Requests that wait until the peers are heard of or tried; more fail at once.
  static constexpr std::size_t kMaxEarlyRequests = 4096;
  static constexpr std::size_t kMaxEarlyBytes = 16U << 20;  // of the requests themselves
  // Of them that are answered before others get their turn.
  static constexpr int kEarlyPerTurn = 16;

  // What the list of hosts shows of this one.
  struct Self {
    wire::Greeting greeting;
    std::vector<std::string> addresses;  // that it listens at
    bool insecure = false;               // at one of them other PCs connect unencrypted
    FleetClock* clock = nullptr;         // nullptr: the clock is not watched
  };

  // What is given by reference outlives it.
  FleetService(const EventLoop& loop, Self self, const Registry& registry, Catalog& catalog,
               Peers& peers, RemoteStreams<Mirror>& mirrors, RemoteStreams<RemoteWriter>& writers);
  FleetService(const FleetService&) = delete;
  FleetService& operator=(const FleetService&) = delete;
  ~FleetService();

  void observe(Fleet::Observer* observer) override { observer_ = observer; }
  // A mirror has a new ring in place of that one, as ChannelParts::on_ring_replaced.
  void on_ring_replaced(const Stream& old) {
    if (observer_) observer_->on_ring_replaced(old);
  }
  bool is_there(const StreamId& id) const override {
    return id.host.empty() ? catalog_.find_owner(id).has_value() : catalog_.has(id);
  }
  void when_known(const StreamId& id, std::size_t bytes, std::function<void()> go_on) override;
  void open_reader(const StreamId& id, bool history, const std::string& account,
                   Then<std::shared_ptr<Stream>> then) override;
  void want_history(const StreamId& id) override;
  void open_writer(const StreamId& id, const CreatePlan* plan, const std::string& account,
                   Then<OpenedRing> then) override;
  Result<std::shared_ptr<Stream>> adopt_untrusted(const StreamId& id, Role role, OfferedFiles files,
                                                  bool history,
                                                  const std::string& account) override;
  void forward(const StreamId& id, const local::Request& request,
               Then<local::Response> then) override;
  void list(Then<std::vector<proto::Stream>> then) override;
  void list_clock_pairs(std::function<void(std::vector<ClockPair>)> then) override;
  void list_nodes(NodeTable nodes, std::function<void(NodeTable)> then) override;
  void follow_playback(const proto::FollowPlayback& request,
                       Then<proto::PlaybackFollowers> then) override;
  const StreamInfo* next_stream(const StreamId& id) const override;
  std::vector<local::Host> hosts() const override;
  void describe(local::Daemon& daemon) const override;
  local::Mdns mdns() const;
  Result<UniqueFd> clock_page() const override;
  void ping(const std::string& host, Then<local::RoundTrip> then) override;

 private:
  // Of all hosts to one request; without those that have not answered within kFreshTimeout.
  using Answers = std::map<wire::HostId, Result<net::Frame>>;
  // A request to all hosts that is under way.
  struct Listing {
    std::function<void(Answers)> then;
    std::function<void(const Error&)> fail;  // afterwards, when `then` found no memory
    MonoTime deadline;
    Answers answers;
    std::size_t unanswered = 0;
    bool done = false;
  };

  Result<local::Response> response_to(local::Request::BodyCase request, const StreamId& id,
                                      net::Frame answer) const;
  void answer_early();
  Error with_unavailable_peers(Error error) const;
  Mirror* mirror_without_owner(const StreamId& id) const;
  std::optional<local::Response> describe_mirror(const StreamId& id) const;
  std::shared_ptr<Stream> for_reader(const StreamId& id, bool history,
                                     std::shared_ptr<Stream> ring) const;
  std::vector<const KnownHost*> hosts_by_name() const;
  void ask_all(const net::Frame& request, std::function<void(Answers)> then,
               std::function<void(const Error&)> fail);
  static void finish(Listing& listing);
  void on_list_timeout();

  void on_remote_stream_added(const KnownHost& host, const StreamInfo& stream) override;
  void on_remote_property_set(const StreamInfo& stream) override;
  void on_remote_stream_removed(const KnownHost& host, const StreamInfo& stream) override;

  void state_clock(local::Host& host) const;

  const EventLoop& loop_;
  const Self self_;
  const Registry& registry_;
  Catalog& catalog_;
  Peers& peers_;
  RemoteStreams<Mirror>& mirrors_;
  RemoteStreams<RemoteWriter>& writers_;
  Fleet::Observer* observer_ = nullptr;
  // A request that waits for the peers to settle.
  struct Early {
    std::function<void()> go_on;
    std::size_t bytes = 0;
  };
  std::deque<Early> early_;  // in the order of arrival
  std::size_t early_bytes_ = 0;
  std::deque<std::shared_ptr<Listing>> listings_;  // in the order of their deadlines
  EventSource list_timer_, early_turn_;
};

}  // namespace dssm::daemon
