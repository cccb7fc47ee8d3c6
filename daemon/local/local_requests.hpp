// SPDX-License-Identifier: Apache-2.0
//
// Serves the requests of the local protocol (local.proto), when LocalService passes them on: those
// about the streams of this host, and through a Fleet those about other hosts and their streams. No
// sockets and no events.
#pragma once

#include <deque>
#include <dssm/result.hpp>
#include <dssm/stream.hpp>
#include <functional>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "core/base/unique_fd.hpp"
#include "core/wire/local_protocol.hpp"
#include "daemon/base/limit_use.hpp"
#include "daemon/streams/catalog_requests.hpp"
#include "daemon/streams/open_table.hpp"
#include "daemon/streams/playback_clock_owner.hpp"
#include "daemon/streams/registry.hpp"
#include "daemon/streams/rights.hpp"
#include "daemon/streams/stream.hpp"
#include "local.pb.h"

namespace dssm::daemon {

// A response and the descriptors that go with it, in the order of local.proto.
struct Reply {
  local::Response response;
  std::vector<UniqueFd> descriptors;
};

// Descriptors that arrived, one element per message that brought some. A request that takes
// descriptors takes the oldest element.
using DescriptorQueue = std::deque<std::vector<UniqueFd>>;

// The other hosts, as local requests concern them (FleetService). Results come by a callback that
// is called once: later from the loop, or at once from within the call; never after the Fleet is
// destroyed. An id without a host refers to the only other host that has such a stream; the caller
// searches the own streams first.
class Fleet {
 public:
  template <class T>
  using Then = std::function<void(Result<T>)>;

  // Notified of changes on other hosts.
  class Observer {
   public:
    virtual void on_remote_stream_added(const StreamInfo& stream) = 0;
    virtual void on_remote_property_set(const StreamInfo& stream) = 0;
    virtual void on_remote_stream_removed(const StreamId& id) = 0;
    // Readers of `stream` (a mirror's ring) shall reopen it: there is a new ring.
    virtual void on_ring_replaced(const Stream& stream) = 0;

   protected:
    ~Observer() = default;
  };
  virtual void observe(Observer* observer) = 0;  // nullptr: none

  // Whether the other host that `id` names is there and has such a stream; without a host: whether
  // exactly one other host has one.
  virtual bool is_there(const StreamId& id) const = 0;

  // Continues when it is known who owns `id`, or that nobody does: before that, what follows could
  // fail without a reason.
  //   id     the stream, or only the host that is asked about
  //   bytes  that wait meanwhile
  virtual void when_known(const StreamId& id, std::size_t bytes, std::function<void()> go_on) = 0;

  // The mirror of a stream, with its newest sample. Kept while its Stream is in the OpenTable, and
  // some seconds longer.
  //   history  filled with what its owner's ring holds, as far as it has a place; also after each
  //            cut, while the result is held
  //   account  who is charged for a new mirror or remote writer, as Identity::account()
  virtual void open_reader(const StreamId& id, bool history, const std::string& account,
                           Then<std::shared_ptr<Stream>> then) = 0;
  // A program reads what is missing in the mirror of that stream; there may be none.
  virtual void want_history(const StreamId& id) = 0;

  // A ring of this host that is published into the other host's stream.
  //   plan  create the stream there unless it exists, `id` names the host; nullptr: it must exist,
  //         as with a plan that is only to join it
  virtual void open_writer(const StreamId& id, const CreatePlan* plan, const std::string& account,
                           Then<OpenedRing> then) = 0;

  // Takes back a mirror's or remote writer's ring that a program held while no dssmd ran.
  //   history  as in open_reader()
  virtual Result<std::shared_ptr<Stream>> adopt_untrusted(const StreamId& id, Role role,
                                                          OfferedFiles files, bool history,
                                                          const std::string& account) = 0;

  // Has the owner of the stream `id` serve `request`: Info, GetProperty, SetProperty, Describe or
  // Remove. The response to Info has `mirror` when this host mirrors the stream.
  virtual void forward(const StreamId& id, const local::Request& request,
                       Then<local::Response> then) = 0;

  // The streams of all other hosts, with fresh figures of those that answer within kFreshTimeout,
  // in the order of hosts' names, then of creation.
  static constexpr Duration kFreshTimeout = std::chrono::milliseconds(500);
  virtual void list(Then<std::vector<proto::Stream>> then) = 0;
  // What each host that is up, this one included, states of the samples of the others, by reader,
  // then owner. A host that does not answer within kFreshTimeout, or fails, has one entry, with the
  // error; so has each pair of which its reader states nothing.
  virtual void list_clock_pairs(std::function<void(std::vector<ClockPair>)> then) = 0;
  // What the hosts that are up report of the processes that have streams open, added to `nodes`; of
  // one that does not answer within kFreshTimeout, or fails, the error.
  virtual void list_nodes(NodeTable nodes, std::function<void(NodeTable)> then) = 0;
  // Of what is in the catalog now, the first stream after `id` in the order of hosts' names, names
  // and ids; nullptr: none. Valid until the catalog changes.
  virtual const StreamInfo* next_stream(const StreamId& id) const = 0;

  // Has all other hosts' playback clocks follow as `request` says, and waits kFreshTimeout for
  // their answers.
  virtual void follow_playback(const proto::FollowPlayback& request,
                               Then<proto::PlaybackFollowers> then) = 0;

  virtual std::vector<local::Host> hosts() const = 0;  // this one first
  // Adds the state of mDNS and the credentials.
  virtual void describe(local::Daemon& daemon) const = 0;
  // The page with the state of this PC's clock; not_found: it is not watched.
  virtual Result<UniqueFd> clock_page() const = 0;
  virtual void ping(const std::string& host, Then<local::RoundTrip> then) = 0;

 protected:
  ~Fleet() = default;
};

// What the response to GetDaemon says of the dssmd as a whole.
struct DaemonFacts {
  LimitUses limits;
  std::string config_file;  // empty: it has none
  ClockPolicy clock_policy = ClockPolicy::enforce;
};

class LocalRequests {
 public:
  // What is given by reference outlives it.
  //   fleet  nullptr: there are no other hosts
  LocalRequests(Registry& registry, OpenTable& opens, PlaybackClockOwner& clock,
                const Rights& rights, Fleet* fleet);

  void set_facts_source(std::function<DaemonFacts()> source) { facts_ = std::move(source); }

  using Client = std::shared_ptr<const ClientIdentity>;
  // Called once: later, or at once. If the client has disconnected by then, its opens are removed
  // again.
  using Answer = std::function<void(Result<Reply>)>;

  // Whether the response to `request` may have to wait for another host: it is a List of all hosts,
  // a ListNodes, a ListClockPairs, a PingHost, or about a stream of another host. Offers,
  // WantHistory and ListRights never do.
  bool waits_for_hosts(const local::Request& request) const;

  // The stream of another host that such a request is about, or only that host; nullopt: all hosts.
  std::optional<StreamId> asked_untrusted(const local::Request& request) const;

  // Serves a request that waits for other hosts,
  void ask_hosts_untrusted(const Client& client, const local::Request& request, Answer answer);
  // and any other.
  //   fails  with the failure that is the response
  Result<Reply> serve_untrusted(const Client& client, const local::Request& request,
                                DescriptorQueue& descriptors);

  // The stream that `request` names; nullptr: none.
  static const proto::StreamId* subject(const local::Request& request) noexcept {
    if (request.has_offer()) return &request.offer().id();
    if (request.has_list_rights()) return &request.list_rights().id();
    return request.has_want_history() ? &request.want_history().id() : daemon::subject(request);
  }

 private:
  bool is_elsewhere(const StreamId& id) const;
  Result<Reply> create(const Client& client, const proto::Create& request);
  Result<Reply> open(const Client& client, const proto::Open& request);
  Result<Reply> offer(const Client& client, const local::Offer& request,
                      DescriptorQueue& descriptors);
  Result<Reply> open_clock(const local::OpenClock& request, DescriptorQueue& descriptors);
  Result<Reply> open_clock_page() const;
  Reply list_opens(const Client& client) const;
  Reply list_rights(const Client& client, const StreamId& id) const;
  Reply list_hosts() const;
  Reply get_daemon(const Client& client) const;

  void create_elsewhere(const Client& client, const StreamId& id, const proto::Create& request,
                        Answer answer);
  void open_elsewhere(const Client& client, const StreamId& id, const proto::Open& request,
                      Answer answer);
  void list_all(Answer answer);
  void list_nodes(Answer answer);
  void list_clock_pairs(Answer answer);
  void follow_playback(const Client& client, const proto::FollowPlayback& request, Answer answer);
  void ping(const std::string& host, Answer answer);

  Result<Reply> opened(const OpenEntry& entry);
  Reply record_open(const OpenEntry& entry);

  Registry& registry_;
  OpenTable& opens_;
  PlaybackClockOwner& clock_;
  const Rights& rights_;
  Fleet* const fleet_;
  CatalogRequests catalog_;
  std::function<DaemonFacts()> facts_;  // may be empty
};

}  // namespace dssm::daemon
