// SPDX-License-Identifier: Apache-2.0
//
// Accepts connections of other hosts and remote programs, within the limits, and owns them.
#pragma once

#include <cstdint>
#include <dssm/result.hpp>
#include <list>
#include <map>
#include <memory>
#include <string>
#include <vector>

#include "core/base/unique_fd.hpp"
#include "core/wire/network_protocol.hpp"
#include "daemon/base/acceptor.hpp"
#include "daemon/base/event_loop.hpp"
#include "daemon/base/log.hpp"
#include "daemon/base/turn_queue.hpp"
#include "daemon/link/handshake.hpp"
#include "daemon/link/network_listener.hpp"
#include "daemon/serve/data_communicator.hpp"
#include "daemon/serve/peer_table.hpp"
#include "daemon/serve/served_stream.hpp"
#include "daemon/streams/open_table.hpp"
#include "daemon/streams/playback_clock_owner.hpp"
#include "daemon/streams/registry.hpp"
#include "daemon/streams/rights.hpp"

namespace dssm::daemon {

class ChannelServer final : private StreamObserver, private DataCommunicator::Observer {
 public:
  struct Parts {
    const EventLoop& loop;
    Registry& registry;
    const OpenTable& opens;
    const Rights& rights;
    Logger& logger;
    ClockAssessor* clock = nullptr;  // nullptr: the clock is not watched
    // As in DataCommunicator::Observer, about once a second from each host that proves which one
    // it is; may be empty.
    std::function<void(const wire::Greeting&, const std::optional<clock::HeartbeatTimes>&)>
        on_heartbeat = {};
    bool takes_plain = false;  // with credentials: from other PCs, too
    // Whether a connection comes from a configured peer (Peers::is_configured()); may be empty.
    std::function<bool(const wire::SocketAddress&, const wire::CertifiedPeer*)> is_configured = {};
    PlaybackClockOwner* playback = nullptr;  // nullptr: there is no playback clock
  };

  // self: how this dssmd greets; with its credentials, connections are encrypted. All in `parts`
  // outlive it.
  ChannelServer(const Parts& parts, wire::Greeting self, const PeerTable::Limits& limits);
  ChannelServer(const ChannelServer&) = delete;
  ChannelServer& operator=(const ChannelServer&) = delete;
  ~ChannelServer();  // connected peers get a final failure

  // Accepts from now on. `listener` outlives the server.
  void serve(const NetworkListener& listener);

  // For tests and fuzzers: a connection that is there already.
  Result<void> adopt(std::unique_ptr<wire::Transport> transport,
                     const wire::SocketAddress& address);

  // The own credentials were replaced: ends connections of peers that they do not accept.
  void on_new_credentials();

  // The rights have changed: ends channels that are not allowed any more; watches show what their
  // peers may see now.
  void on_new_rights(const Rights& before);

  // This host's clock has a new generation: notifies the hosts that are connected.
  void send_clock();
  // Assessments of clocks may have changed; at least once a second.
  void on_clock();

  void set_limits(const PeerTable::Limits& limits) {
    limits_ = limits;
    peers_.set_limits(limits);
  }
  void add_limits(LimitUses& out) const { peers_.add_limits(out); }
  // For subscriptions from now on.
  void set_sending(SendingDemands sending) { sending_ = std::move(sending); }

 private:
  // A connection of a peer that has not sent its Hello.
  struct Arrival {
    std::string address;  // without port
    std::string network;  // of that address
    // One of both: TLS is under way, or it has a place in the PeerTable, under the name `peer`.
    std::unique_ptr<Handshake> handshake = nullptr;
    DataCommunicator* communicator = nullptr;
    std::string peer = {};
    bool is_configured = false;
    bool ended = false;  // to be destroyed outside of its own callback
  };

  Result<void> accept(UniqueFd& socket);
  void secure(UniqueFd socket, const wire::SocketAddress& address);
  void on_secured(Arrival& arrival, const wire::SocketAddress& address,
                  Result<std::unique_ptr<wire::Transport>> transport);
  std::string refuses(const wire::SocketAddress& address) const;
  void refuse(wire::Transport& transport, const wire::SocketAddress& address, const Error& error);
  Result<void> keep(std::unique_ptr<wire::Transport>& transport,
                    const wire::SocketAddress& address);
  void give_up_one(const std::function<bool(const Arrival&)>& may_go);
  void forget_arrival(const DataCommunicator& communicator);
  void sweep();

  void on_stream_added(const Stream& stream) override;
  void on_stream_described(const Stream& stream) override { on_stream_added(stream); }
  void on_property_set(const Stream& stream) override;
  void on_stream_removed(const Stream& stream) override;
  void on_recovered() override;
  void on_ended(DataCommunicator& communicator) override;
  void on_greeted(DataCommunicator& communicator) override { forget_arrival(communicator); }
  void on_heartbeat(const wire::Greeting* host,
                    const std::optional<clock::HeartbeatTimes>& returned) override;

  Parts parts_;
  RateLimitedLogger logger_;
  wire::Greeting self_;
  PeerTable::Limits limits_;
  PeerTable peers_;
  HandshakeBudget handshake_budget_;
  std::list<Arrival> arrivals_;  // the oldest first
  SendingDemands sending_;
  ServedStreams streams_;
  TurnQueue turns_;
  MonoTime checked_{};  // all streams
  std::map<DataCommunicator*, std::unique_ptr<DataCommunicator>> communicators_;
  std::vector<DataCommunicator*> ended_;  // to be destroyed outside of their own callbacks
  EventSource sweep_;
  Acceptor acceptor_;
};

}  // namespace dssm::daemon
