// SPDX-License-Identifier: Apache-2.0
//
// The other hosts, as LocalService uses them. Results come by a callback that is called once: later
// from the loop, or at once from within the call; never after the Fleet is destroyed. An id without
// a host refers to the only other host that has such a stream; the caller searches the own streams
// first.
#pragma once

#include <dssm/result.hpp>
#include <dssm/stream.hpp>
#include <functional>
#include <memory>
#include <string>
#include <vector>

#include "daemon/streams/create_plan.hpp"
#include "daemon/streams/stream.hpp"
#include "local.pb.h"

namespace dssm::daemon {

class Fleet {
 public:
  template <class T>
  using Then = std::function<void(Result<T>)>;

  // Notified of changes on other hosts.
  class Observer {
   public:
    virtual void on_remote_stream_added(const StreamInfo& stream) = 0;
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

  // The mirror of a stream, filled with its history. Kept while its Stream is in the OpenTable, and
  // some seconds longer.
  virtual void open_reader(const StreamId& id, Then<std::shared_ptr<Stream>> then) = 0;

  // A ring of this host that is published into the other host's stream.
  //   plan  create the stream there unless it exists, `id` names the host; nullptr: it must exist
  virtual void open_writer(const StreamId& id, const CreatePlan* plan, Then<OpenedRing> then) = 0;

  // Takes back a mirror's or remote writer's ring that a program held while no dssmd ran.
  virtual Result<std::shared_ptr<Stream>> adopt_untrusted(const StreamId& id, Role role,
                                                          OfferedFiles files) = 0;

  // Has the owner of the stream `id` serve `request`: Info, GetProperty, SetProperty or Remove. The
  // response to Info has `mirror` when this host mirrors the stream.
  virtual void forward(const StreamId& id, const local::Request& request,
                       Then<local::Response> then) = 0;

  // The streams of all other hosts, with fresh figures of those that answer within kFreshTimeout,
  // in the order of hosts' names, then of creation.
  static constexpr Duration kFreshTimeout = std::chrono::milliseconds(500);
  virtual void list(Then<std::vector<proto::Stream>> then) = 0;
  // What is in the catalog now, without a request to other hosts: for Watch.
  virtual std::vector<StreamInfo> known_streams() const = 0;

  virtual std::vector<local::Host> hosts() const = 0;  // this one first
  virtual local::Mdns mdns() const = 0;                // the state of mDNS
  // The page with the state of this PC's clock; not_found: it is not watched.
  virtual Result<UniqueFd> clock_page() const = 0;
  virtual void ping(const std::string& host, Then<local::RoundTrip> then) = 0;

 protected:
  ~Fleet() = default;
};

}  // namespace dssm::daemon
