// SPDX-License-Identifier: Apache-2.0
//
// Notifies the senders of a stream's samples to other hosts of new samples. It watches the stream's
// doorbells, edge-triggered and without ever reading them: a ring costs the writer one write and
// dssmd no read.
//
// The doorbells are armed only while an observer waits for a sample: a writer that is faster than
// the network, or whose stream has no observer, writes without a system call. The ring is checked
// again after arming, so that no sample is missed: either the writer sees the doorbell armed, or
// the feed sees its sample (both sides store, then load, and no load passes the store:
// SlotWriter::publish_before_unlock()).
#pragma once

#include <dssm/result.hpp>
#include <map>
#include <memory>
#include <vector>

#include "core/ring/ring_memory.hpp"
#include "core/ring/ring_reader.hpp"
#include "daemon/base/event_loop.hpp"
#include "daemon/streams/stream.hpp"

namespace dssm::daemon {

class StreamFeed final : private DoorbellObserver {
 public:
  class Observer {
   public:
    // A sample newer than the one known is in the ring; called once per wait(), from the loop. May
    // call wait() and forget().
    virtual void on_sample_available() = 0;

   protected:
    ~Observer() = default;
  };

  // At most one feed per stream at a time. loop outlives it.
  static Result<std::shared_ptr<StreamFeed>> open(const EventLoop& loop,
                                                  std::shared_ptr<Stream> stream);
  StreamFeed(const StreamFeed&) = delete;
  StreamFeed& operator=(const StreamFeed&) = delete;
  ~StreamFeed();

  // Waits for a sample newer than `known`; replaces an earlier wait() of this observer. False when
  // there is one already: then the observer is not called.
  bool wait(Observer& observer, Tid known);
  // Ends its wait().
  void forget(Observer& observer) noexcept;

  // A sample was written, or may have been: by dssmd itself, or by a writer that died before it
  // rang.
  void poll();

 private:
  struct Waiting {
    Observer* observer;
    Tid known;
  };

  StreamFeed(const EventLoop& loop, std::shared_ptr<Stream> stream,
             std::shared_ptr<const ring::RingMapping> ring);
  void on_doorbell_added(int fd) override;
  void on_doorbell_removed(int fd) override;
  void arm(bool armed) noexcept;

  const EventLoop& loop_;
  std::shared_ptr<Stream> stream_;
  std::shared_ptr<const ring::RingMapping> ring_;  // read-write
  ring::RingReader reader_;
  bool armed_ = false;
  std::vector<Waiting> waiting_;
  // During poll(): those still to be notified; nullptr after forget().
  std::vector<Waiting> notifying_;
  bool polling_ = false, poll_again_ = false;
  std::map<int, EventSource> doorbells_;  // by descriptor
  EventSource poll_soon_;
};

}  // namespace dssm::daemon
