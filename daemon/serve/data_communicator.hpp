// SPDX-License-Identifier: Apache-2.0
//
// The server end of one connection from another host or a remote program: greets, authorizes each
// request and passes it on in its turn. The first request decides what the connection is for: a
// channel carries one stream (StreamChannel), a control connection asks about all
// of them (CatalogRequests, StreamWatch) and about clocks.
//
// Backpressure: a request is served only while nothing waits to be sent; until then one waits here
// and the others on the peer's side. So a peer that asks and never reads costs one answer. While
// the Registry recovers, a request about a stream that may come back waits the same way.
#pragma once

#include <deque>
#include <dssm/result.hpp>
#include <functional>
#include <memory>
#include <optional>
#include <set>
#include <string>

#include "core/wire/network_protocol.hpp"
#include "core/wire/tls_credentials.hpp"
#include "core/wire/transport.hpp"
#include "daemon/base/event_loop.hpp"
#include "daemon/base/log.hpp"
#include "daemon/base/turn_queue.hpp"
#include "daemon/link/frame_connection.hpp"
#include "daemon/serve/peer_table.hpp"
#include "daemon/serve/served_stream.hpp"
#include "daemon/serve/stream_channel.hpp"
#include "daemon/streams/catalog_requests.hpp"
#include "daemon/streams/open_table.hpp"
#include "daemon/streams/playback_clock_owner.hpp"
#include "daemon/streams/registry.hpp"
#include "daemon/streams/rights.hpp"

namespace dssm::daemon {

// One control connection that watches the streams of this host: first an event for each existing
// stream, then, when the Registry has recovered, the response to Watch, then changes. The first
// events are sent as fast as the peer receives them, so that thousands of streams need no memory
// for a queue.
class StreamWatch {
 public:
  // Events sent in a row before others get their turn.
  static constexpr int kStreamsPerTurn = 64;

  // shows: what the peer may see. All outlive it.
  using Shows = std::function<bool(const StreamId& stream)>;
  StreamWatch(const Registry& registry, const OpenTable& opens, FrameConnection& link, Shows shows,
              std::uint64_t serial);

  // Sends events while the link takes them. True when others should have their turn and work() be
  // called again; else nothing is left, or on_output_empty() comes.
  bool work();
  bool has_more() const noexcept { return !pending_.empty() || serial_ != 0; }

  void on_stream_added(const Stream& stream);
  void on_property_set(const Stream& stream);
  void on_stream_removed(const Stream& stream);
  // The peer may see other streams than before.
  //   showed  what it could see
  void on_new_rights(const Shows& showed);

 private:
  // An event that waits for the link.
  struct Pending {
    std::weak_ptr<const Stream> stream;
    std::optional<Tid> property_after;  // its property was set, after that sample
  };
  void send_added(const Stream& stream, std::optional<Tid> property_after = {});
  void send_removed(const Stream& stream);

  const Registry& registry_;
  const OpenTable& opens_;
  FrameConnection& link_;
  Shows shows_;
  std::uint64_t serial_;  // of Watch; 0: answered
  std::deque<Pending> pending_;
};

class DataCommunicator final : private FrameConnection::Observer, private StreamChannel::Observer {
 public:
  // Requests of one connection served in a row before others get their turn: so many, or as many as
  // are begun in that time.
  static constexpr int kRequestsPerTurn = 16;
  static constexpr Duration kMaxTurn = std::chrono::milliseconds(1);
  // How long a connection may send nothing that is neither a channel nor has heartbeats: otherwise
  // those that are forgotten, or meant to, would take all places.
  static constexpr Duration kIdleTimeout = std::chrono::seconds(10);
  // How long a peer may read nothing of the answers and events that wait for it. It may of samples
  // that it has subscribed to: a program may be stopped by a debugger.
  static constexpr Duration kOutputTimeout = std::chrono::seconds(10);
  // Answers and events that may wait for one connection: the longest answer is a property.
  static constexpr std::size_t kMaxQueuedBytes = wire::kMaxNetworkFrameBytes + (1U << 20);

  // The owner of the connection.
  class Observer {
   public:
    // It ended; to be destroyed later, not from within this call.
    virtual void on_ended(DataCommunicator& communicator) = 0;
    // The peer has sent its Hello.
    virtual void on_greeted(DataCommunicator& /*communicator*/) {}
    // A heartbeat arrived; it is answered afterwards.
    //   host      whose it is; nullptr: a program's, or of one that does not prove which host it is
    //   returned  when this host's answer to the heartbeat before left and came there, and when
    //             this heartbeat left there and came; nullopt: not known. Untrusted
    virtual void on_heartbeat(const wire::Greeting* /*host*/,
                              const std::optional<clock::HeartbeatTimes>& /*returned*/) {}

   protected:
    ~Observer() = default;
  };

  // What all connections share.
  struct Parts {
    const EventLoop& loop;
    Registry& registry;
    const OpenTable& opens;
    ServedStreams& streams;
    TurnQueue& turns;
    const wire::Greeting& self;
    Logger& logger;
    Observer& observer;
    ClockAssessor* clock;  // nullptr: the clock is not watched
    const Rights& rights;
    const SendingDemands& sending;
    PlaybackClockOwner* playback;  // nullptr: none
  };

  // peer_address: for the log, "10.0.0.3:40000". All in `parts` outlive it.
  DataCommunicator(const Parts& parts, PeerPlace place, std::unique_ptr<wire::Transport> transport,
                   std::string peer_address);
  DataCommunicator(const DataCommunicator&) = delete;
  DataCommunicator& operator=(const DataCommunicator&) = delete;
  ~DataCommunicator();

  void on_stream_added(const Stream& stream);
  void on_property_set(const Stream& stream);
  void on_stream_removed(const Stream& stream);
  void on_recovered();

  // This host's clock has a new generation: notifies control connections with the feature.
  void send_clock();

  // Closes when `credentials` do not accept the peer.
  void on_new_credentials(const wire::TlsCredentials& credentials);

  // Closes a channel on which something was allowed that is not any more; a watch shows what the
  // peer may see now.
  void on_new_rights(const Rights& before);

  // Sends a final failure, as far as the socket takes it at once.
  void close_with(const Error& why) { link_.close_with(why); }

 private:
  // An Open or Create that is not answered yet.
  struct Opening {
    std::uint64_t serial = 0;
    std::shared_ptr<Stream> stream;
    bool created = false;
    std::uint64_t reserved_bytes = 0;  // of the ring, when it is created here
  };

  Result<void> on_frame(net::Frame& frame) override;
  void on_output_empty() override;
  void on_closed(const Error& why) override;
  void work_now() override;
  void work_soon() override;
  void do_work();

  Result<void> greet(const net::Frame& frame);
  bool proves_host() const;
  void become_control();
  bool can_serve(const net::Frame& request) const;
  void serve(const net::Frame& request);
  Result<void> check_access(const net::Frame& request);
  Result<void> dispatch(const net::Frame& request);
  Result<void> serve_control(const net::Frame& request);
  Result<void> open(const net::Frame& request);
  Result<void> create(const net::Frame& request);
  Result<void> check_clock(const StreamId& id) const;
  Result<void> go_on_opening();
  Result<bool> reserve_some();
  void send_failure(std::uint64_t serial, const Error& error);
  void check_peer_timeout();
  void check_idle();
  std::string peer() const;
  void log_end(const Error& why);

  Parts parts_;
  PeerPlace place_;
  std::string peer_address_;
  FrameConnection link_;
  std::optional<wire::Greeting> them_;  // after their Hello
  Identity identity_;                   // likewise
  Error their_failure_;                 // the peer's final failure; empty: none
  struct Waiting {
    net::Frame request;
    MemoryShare share;
  };
  std::optional<Waiting> waiting_;  // a request whose turn has not come; the link is paused
  int served_ = 0;                  // in this turn
  Duration served_for_ = {};        // likewise
  bool is_control_ = false;
  RawTime pong_sent_{};  // the last answer to a Ping with raw_ns
  CatalogRequests catalog_;
  std::unique_ptr<StreamWatch> watch_;
  std::optional<Opening> opening_;
  std::unique_ptr<StreamChannel> channel_;
  std::set<Action> allowed_;  // on the channel
  TurnQueue::Turn turn_;      // to serve what waits, and for samples
  bool turn_is_due_ = false;  // to go on with what is in progress
  EventSource next_turn_, greeting_timeout_, idle_timeout_, peer_timeout_;
};

}  // namespace dssm::daemon
