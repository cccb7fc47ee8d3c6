// SPDX-License-Identifier: Apache-2.0
//
// The server end of one connection from another host or a remote program: greets, authorizes each
// request and passes it on in its turn. The first request decides what the connection is for: a
// channel carries one stream (StreamChannel), a control connection asks about all
// of them (CatalogRequests, StreamWatch).
//
// Backpressure: a request is served only while nothing waits to be sent; until then one waits here
// and the others on the peer's side. So a peer that asks and never reads costs one answer.
#pragma once

#include <dssm/result.hpp>
#include <memory>
#include <optional>
#include <string>

#include "core/wire/network_protocol.hpp"
#include "core/wire/transport.hpp"
#include "daemon/base/event_loop.hpp"
#include "daemon/base/log.hpp"
#include "daemon/link/frame_connection.hpp"
#include "daemon/serve/peer_table.hpp"
#include "daemon/serve/ring_reservation.hpp"
#include "daemon/serve/served_stream.hpp"
#include "daemon/serve/stream_channel.hpp"
#include "daemon/serve/stream_watch.hpp"
#include "daemon/streams/authorize.hpp"
#include "daemon/streams/catalog_requests.hpp"
#include "daemon/streams/open_table.hpp"
#include "daemon/streams/registry.hpp"

namespace dssm::daemon {

class DataCommunicator final : private FrameConnection::Observer, private StreamChannel::Observer {
 public:
  // Requests of one connection served in a row before others get their turn.
  static constexpr int kRequestsPerTurn = 16;
  // Answers and events that may wait for one connection: the longest answer is a property.
  static constexpr std::size_t kMaxQueuedBytes = wire::kMaxNetworkFrameBytes + (1U << 20);

  // The owner of the connection.
  class Observer {
   public:
    // It ended; to be destroyed later, not from within this call.
    virtual void on_ended(DataCommunicator& communicator) = 0;
    // A heartbeat arrived.
    virtual void on_heartbeat() {}

   protected:
    ~Observer() = default;
  };

  // What all connections share.
  struct Parts {
    const EventLoop& loop;
    Registry& registry;
    const OpenTable& opens;
    ServedStreams& streams;
    const wire::Greeting& self;
    Logger& logger;
    Observer& observer;
    ClockAssessor* clock;  // nullptr: the clock is not watched
    const Authorizer& authorizer;
  };

  // peer_address: for the log, "10.0.0.3:40000". All in `parts` outlive it.
  DataCommunicator(const Parts& parts, PeerPlace place, std::unique_ptr<wire::Transport> transport,
                   std::string peer_address);
  DataCommunicator(const DataCommunicator&) = delete;
  DataCommunicator& operator=(const DataCommunicator&) = delete;
  ~DataCommunicator();

  void on_stream_added(const Stream& stream);
  void on_stream_removed(const Stream& stream);

  // This host's clock has a new generation: notifies control connections with the feature.
  void send_clock();

  // Sends a final failure, as far as the socket takes it at once.
  void close_with(const Error& why) { link_.close_with(why); }

 private:
  // An Open or Create that is not answered yet.
  struct Opening {
    std::uint64_t serial = 0;
    std::shared_ptr<Stream> stream;
    bool created = false;
    std::optional<RingReservation> reservation;
  };

  Result<void> on_frame(net::Frame& frame) override;
  void on_output_empty() override;
  void on_closed(const Error& why) override;
  void work_now() override;
  void work_soon() override;

  Result<void> greet(const net::Frame& frame);
  bool can_serve() const noexcept;
  void serve(const net::Frame& request);
  Result<void> check_access(const net::Frame& request) const;
  Result<void> dispatch(const net::Frame& request);
  Result<void> serve_control(const net::Frame& request);
  Result<void> open(const net::Frame& request);
  Result<void> create(const net::Frame& request);
  Result<void> check_clock(const StreamId& id) const;
  Result<void> go_on_opening();
  void send_failure(std::uint64_t serial, const Error& error);
  void check_peer_timeout();
  std::string peer() const;
  void log_end(const Error& why);

  Parts parts_;
  PeerPlace place_;
  std::string peer_address_;
  FrameConnection link_;
  std::optional<wire::Greeting> them_;  // after their Hello
  Identity identity_;                   // likewise
  Error their_failure_;                 // the peer's final failure; empty: none
  std::optional<net::Frame> waiting_;   // a request whose turn has not come; the link is paused
  int served_ = 0;                      // in this turn
  bool is_control_ = false;
  CatalogRequests catalog_;
  std::unique_ptr<StreamWatch> watch_;
  std::optional<Opening> opening_;
  std::unique_ptr<StreamChannel> channel_;
  bool turn_is_due_ = false;
  EventSource next_turn_, greeting_timeout_, peer_timeout_;
};

}  // namespace dssm::daemon
