// SPDX-License-Identifier: Apache-2.0
//
// Tells those who send a stream's samples to other hosts when there are new ones. Listens to the
// stream's doorbells, edge-triggered: nobody ever reads them, so that a ring costs the writer one
// write and dssmd no read.
//
// The doorbells are armed only while somebody waits for news: a writer that is faster than the
// network, or whose stream nobody waits for, writes without a system call. After arming, the ring
// is looked at once more, so that no sample is missed: either the writer sees the doorbell armed,
// or we see its sample (both sides store, then load, sequentially consistent).
#pragma once

#include <dssm/result.hpp>
#include <memory>
#include <vector>

#include "core/ring/bell.hpp"
#include "core/ring/ring_reader.hpp"
#include "daemon/base/event_loop.hpp"
#include "daemon/streams/stream.hpp"

namespace dssm::daemon {

class StreamFeed final : private DoorbellObserver {
 public:
  class Observer {
   public:
    // There is a sample newer than the one known; called once per wait(), from the loop. May call
    // wait() and forget().
    virtual void on_news() = 0;

   protected:
    ~Observer() = default;
  };

  // At most one feed per stream at a time. loop outlives it.
  static Result<std::shared_ptr<StreamFeed>> open(const EventLoop& loop,
                                                  std::shared_ptr<Stream> stream);
  StreamFeed(const StreamFeed&) = delete;
  StreamFeed& operator=(const StreamFeed&) = delete;
  ~StreamFeed();

  // Waits for a sample newer than `known`, instead of what this observer waited for before. False
  // when there is one already: then nothing follows.
  bool wait(Observer& observer, Tid known);
  // Nothing follows any more.
  void forget(Observer& observer) noexcept;

  // A sample was written, or may have been: by dssmd itself, or by a writer that died before it
  // could ring.
  void look();

 private:
  struct Waiting {
    Observer* observer;
    Tid known;
  };

  StreamFeed(const EventLoop& loop, std::shared_ptr<Stream> stream,
             std::shared_ptr<ring::Bell> bell);
  void on_doorbell_added(int fd) override;
  void arm(bool armed) noexcept;

  const EventLoop& loop_;
  std::shared_ptr<Stream> stream_;
  std::shared_ptr<ring::Bell> bell_;
  ring::RingReader reader_;
  bool armed_ = false;
  std::vector<Waiting> waiting_;
  std::vector<Waiting> told_;  // while look() works: those still to be told, or null by forget()
  bool looking_ = false, look_again_ = false;
  std::vector<EventSource> doorbells_;
};

}  // namespace dssm::daemon
