// SPDX-License-Identifier: Apache-2.0
//
// The local protocol without its socket: serves the requests of all clients of this PC, and sends
// StreamEvents to those that watch. Connection and Server carry the bytes; tests and fuzzers pass
// frames directly.
//
// Each request passes Rights::check(), and lists and events show what the client may see. Requests
// about streams of other hosts go to the Fleet, which responds later; when the client has
// disconnected by then, the response is dropped.
//
// A ring can get a successor: a stream is created again under the name of a removed one, its owner
// restarted without its rings, or another host has it now. Readers of the old ring get the event
// Replaced and reopen the stream by the name that they used the first time: so it may move to
// another host only for those that named none.
//
// After a crash of the dssmd before this one, programs that still hold streams reconnect and offer
// them. While the Registry recovers, a Watch, and a request about a stream that is not offered yet,
// is deferred, not refused: otherwise a restarted writer could take the name of a ring that others
// still use.
#pragma once

#include <cstddef>
#include <deque>
#include <dssm/result.hpp>
#include <functional>
#include <map>
#include <memory>
#include <optional>
#include <set>
#include <span>
#include <string>
#include <vector>

#include "core/base/unique_fd.hpp"
#include "daemon/base/log.hpp"
#include "daemon/local/local_requests.hpp"
#include "daemon/streams/open_table.hpp"
#include "daemon/streams/playback_clock_owner.hpp"
#include "daemon/streams/registry.hpp"
#include "daemon/streams/rights.hpp"

namespace dssm::daemon {

// Where a client's frames go, whole or in parts. send() must not call back into LocalService, but
// for disconnect() of that same client.
class ClientOutput {
 public:
  virtual void send(std::string bytes, std::vector<UniqueFd> descriptors) = 0;
  // Has LocalService::go_on() called, from the loop.
  virtual void request_turn() = 0;

 protected:
  ~ClientOutput() = default;
};

class LocalService final : private StreamObserver, private Fleet::Observer {
 public:
  // Requests of one client that wait for other hosts; and of all clients of one account, also those
  // that have disconnected: half of what may wait for one peer.
  static constexpr std::size_t kMaxAwaited = 1024;
  static constexpr std::size_t kMaxAwaitedPerUser = 2048;
  static constexpr std::size_t kMaxAwaitedBytesPerUser = 3U << 19;
  // What a ping counts: it takes this PC's clock along.
  static constexpr std::size_t kPingBytes = 2U << 10;
  // What one client, and all clients of one account, may have deferred during recovery; each
  // request counts as so many bytes more than it has.
  static constexpr std::size_t kMaxDeferredBytes = 1U << 20;
  static constexpr std::size_t kMaxDeferredBytesPerUser = 16U << 20;
  static constexpr std::size_t kDeferredBytes = 1U << 10;
  // Events for one that watches, before others get their turn: so many, or as many as begin within
  // these bytes.
  static constexpr int kStreamsPerTurn = 64;
  static constexpr std::size_t kStreamBytesPerTurn = 64U << 10;
  // Events that wait for the turns of those that watch. Beyond that the oldest ones go into the
  // output of each.
  static constexpr std::size_t kMaxNewsBytes = 16U << 20;
  // Opens of a client that has ended, before others get their turn.
  static constexpr std::size_t kOpensPerTurn = 256;

  // fleet: outlives this; nullptr: there are no other hosts.
  LocalService(Registry& registry, OpenTable& opens, PlaybackClockOwner& clock,
               const Rights& rights, Logger& logger, Fleet* fleet = nullptr);
  LocalService(const LocalService&) = delete;
  LocalService& operator=(const LocalService&) = delete;
  ~LocalService();

  // Of the response to GetDaemon; called from the loop. Until it is set, there are none.
  void set_facts_source(std::function<DaemonFacts()> source) {
    requests_.set_facts_source(std::move(source));
  }

  // A client connected; `output` stays until disconnect().
  //   identity  without the program's name
  ClientNumber connect(const Identity& identity, ClientOutput& output);
  //   by_client  the client ended the connection, or ended itself: what it had not closed before,
  //              it did not close. Otherwise dssmd ended it, and the client may connect again
  //   returns    whether it has more than kOpensPerTurn opens, which are still to be ended: by
  //              leave()
  bool disconnect(ClientNumber number, bool by_client = false);
  // Goes on with that; again while it returns true.
  bool leave(ClientNumber number, bool by_client) {
    return opens_.remove_some(number, by_client, kOpensPerTurn);
  }
  // The client has ended, or will receive nothing more. Of the requests that it sent before, those
  // are served that change something: they say which streams it closed.
  void on_reader_gone(ClientNumber number);
  bool has_greeted(ClientNumber number) const { return clients_.at(number).greeted; }
  std::size_t clients() const noexcept { return clients_.size(); }

  // One frame of a client, without its length. The response goes to its output before this returns,
  // or later for a request that is deferred.
  //   returns  false: the client does not keep to the protocol, the connection must end
  bool on_frame_untrusted(ClientNumber number, std::span<const std::byte> frame,
                          DescriptorQueue& descriptors);

  // Sends some of the events that the client has not got, if it watches: first of what has changed,
  // then of existing streams; or serves one of its deferred requests. Call it as fast as the client
  // receives, and before its further requests.
  //   returns  whether there is more
  bool go_on(ClientNumber number);

  // The rights have changed: ends opens that are not allowed any more. Their readers reopen, and
  // get the failure that says why they may not. Mirrors and remote writers end that no other
  // program has open. Watches are told all again: what they may see, and what not any more.
  void on_new_rights(const Rights& before);

 private:
  // How far a client that watches has been told of the streams that exist: first this PC's own ones
  // in the order of creation, then those of other hosts. A place, not a list, so that many clients
  // that do not read need no memory for it.
  struct Watch {
    bool is_telling = true;
    std::vector<std::uint64_t> serials;  // of Watch requests that are answered at the end
    std::uint64_t own = 0;               // created_order() of the last one
    StreamId others;                     // the last one
    // By which it may know streams that it may not see any more; empty: none.
    std::vector<std::shared_ptr<const Rights>> before;
    std::uint64_t news = 0;  // the number of the next one for it
  };
  // An event for all that watch. Each gets it in a turn of its own, because there may be thousands.
  struct News {
    StreamId stream;
    bool is_removed = false;
    std::string frame;  // empty: its property was set again later
  };
  struct Deferred {
    local::Request request;
    std::size_t bytes = 0;
  };
  struct Client {
    std::shared_ptr<const ClientIdentity> identity;
    ClientOutput* output = nullptr;
    bool greeted = false;
    bool has_reader = true;  // of what is sent
    std::optional<Watch> watch;
    std::deque<Deferred> deferred;  // in the order of arrival
    std::size_t deferred_bytes = 0;
    bool may_serve_deferred = false;  // some of them may not have to wait any more
    std::size_t awaited = 0;          // answers of other hosts
  };
  struct AwaitedOfUser {
    std::size_t requests = 0, bytes = 0;
  };
  class AwaitedRequest;

  bool refuse(const Client& client, std::uint64_t serial, const Error& error);
  Result<void> check_access(const ClientIdentity& client, const local::Request& request);
  bool exists(const StreamId& id) const;
  bool is_only_user(const ClientIdentity& client, const StreamId& id) const;
  bool greet(Client& client, std::uint64_t serial, const proto::Hello& hello);
  void serve(ClientNumber number, const local::Request& request, DescriptorQueue& descriptors);
  void ask_hosts(const std::shared_ptr<const ClientIdentity>& client, const local::Request& request,
                 const LocalRequests::Answer& answer);
  LocalRequests::Answer await(ClientNumber number, const local::Request& request);
  Result<void> check_awaited(const Client& client, const AwaitedOfUser& of_user,
                             std::size_t bytes) const;
  void on_answer(ClientNumber number, std::uint64_t serial, Result<Reply> reply);
  void log_offer(const ClientIdentity& client, const local::Offer& offer,
                 const Result<Reply>& reply);
  void watch(ClientNumber number, std::uint64_t serial);
  void end_watch(ClientNumber number, Client& client);
  void list_clients(const Client& client, std::uint64_t serial);
  void send(const Client& client, std::uint64_t serial, Reply reply);
  void send_failure(const Client& client, std::uint64_t serial, const Error& error);
  void broadcast(const proto::StreamEvent& event);
  std::uint64_t end_of_news() const noexcept { return first_news_ + news_.size(); }
  bool tell_news(ClientNumber number, std::uint64_t end);
  void clear_property_news(const StreamId& stream);
  void drop_news();
  bool tell_streams(ClientNumber number);
  bool shows(const Client& client, const StreamId& id) const;
  bool showed(const Client& client, const StreamId& id) const;
  std::vector<proto::StreamEvent> next_events(Client& client) const;
  bool send_events(ClientNumber number, const std::vector<proto::StreamEvent>& events);

  bool must_wait(const local::Request& request) const;
  void defer(Client& client, const local::Request& request, std::size_t bytes);
  void serve_deferred();
  bool serve_deferred(ClientNumber number);

  void on_stream_added(const Stream& stream) override;
  void on_stream_described(const Stream& stream) override;
  void on_property_set(const Stream& stream) override;
  void on_stream_removed(const Stream& stream) override;
  void on_recovered() override { serve_deferred(); }
  void on_remote_stream_added(const StreamInfo& stream) override;
  void on_remote_property_set(const StreamInfo& stream) override;
  void on_remote_stream_removed(const StreamId& id) override;
  void on_ring_replaced(const Stream& stream) override;
  void notify_replaced(const OpenTable::Reading& reading);
  void notify_successors(const StreamId& id);
  bool is_gone(const Stream& stream) const;

  Registry& registry_;
  OpenTable& opens_;
  PlaybackClockOwner& clock_;
  const Rights& rights_;
  RateLimitedLogger logger_, refusals_;
  LocalRequests requests_;
  Fleet* fleet_;
  ClientNumber next_client_ = 1;
  std::map<ClientNumber, Client> clients_;
  // By user id; kept by the requests that wait.
  std::map<std::uint32_t, std::weak_ptr<AwaitedOfUser>> awaited_;
  std::deque<News> news_;  // that some client has not got
  std::uint64_t first_news_ = 0;
  // The number of the newest event that a property was set, by the stream's full name.
  std::map<std::string, std::uint64_t> properties_;
  std::size_t news_bytes_ = 0, kept_news_ = 0;  // kept_news_: how many drop_news() left
  std::size_t watches_ = 0;
  std::set<ClientNumber> informed_;  // clients that watch, and have got all news
};

}  // namespace dssm::daemon
