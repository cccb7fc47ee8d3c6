// SPDX-License-Identifier: Apache-2.0
//
// Pollable descriptors for readers. Writers wake readers through futexes, which poll() cannot wait
// for; a notifier thread waits for up to kMaxWatched readers and signals an eventfd for each whose
// ring changed. It works without dssmd.
#pragma once

#include <atomic>
#include <dssm/sample.hpp>
#include <memory>
#include <mutex>
#include <thread>
#include <vector>

#include "client/src/open_streams.hpp"
#include "core/ring/bell.hpp"
#include "core/ring/ring_reader.hpp"

namespace dssm::detail {

// The ring that a reader's descriptor is about.
struct ReadyRing {
  std::shared_ptr<const SharedRing> ring;
  std::shared_ptr<const std::atomic<bool>> superseded;  // by another ring
  Tid seen = kNoTid;                                    // newest sample already signalled
};

// A reader's descriptor. Readable when the ring's newest tid rose since the last clear(), when a
// part of a mirror's hole was filled, or when the ring was superseded; then again and again, until
// the reader has the new ring: an attempt to open it may come too early. Thread-safe.
class ReadyFd {
 public:
  ReadyFd(ReadyRing ring, UniqueFd event)
      : ring_(std::move(ring)), times_(times()), event_(std::move(event)) {}

  int fd() const noexcept { return event_.get(); }
  void clear() noexcept;

 private:
  friend class Notifier;
  friend class NotifierPool;
  std::shared_ptr<const SharedRing> ring();
  bool poll() noexcept;  // signals fd() if the ring changed
  void follow(ReadyRing ring);
  Duration next_sleep(MonoTime now) noexcept;  // until it is polled again
  ring::SleepTimes times() const { return ring::SleepTimes(ring_.ring->mapping->identity().cycle); }

  std::mutex mutex_;  // guards what follows, but for event_
  ReadyRing ring_;
  ring::SleepTimes times_;                        // since it changed
  MonoTime superseded_since_{}, next_restart_{};  // when that is signalled again
  Tid seen_hole_end_ = 0;  // when it changed, samples may have come that a reader waits for
  UniqueFd event_;
};

// One thread and the readers that it waits for. Thread-safe.
class Notifier {
 public:
  static constexpr std::size_t kMaxWatched = 127;  // of futex_waitv's 128 one is our own

  static Result<std::unique_ptr<Notifier>> start();
  ~Notifier();

  // False when it is full.
  bool add(const std::shared_ptr<ReadyFd>& ready);
  // It checks its list and all rings.
  void wake() noexcept;

 private:
  Notifier() = default;
  void run();

  std::shared_ptr<ring::Bell> control_;  // rung when the list changes
  std::atomic<std::uint32_t> wakes_ = 0;
  std::mutex mutex_;
  std::vector<std::weak_ptr<ReadyFd>> watched_;
  bool stopping_ = false;
  std::thread thread_;
};

// As many notifiers as are needed. Thread-safe.
class NotifierPool {
 public:
  Result<std::shared_ptr<ReadyFd>> watch(ReadyRing ring);
  // From now on `ready` is about another ring.
  void follow(ReadyFd& ready, ReadyRing ring);

 private:
  std::mutex mutex_;
  std::vector<std::unique_ptr<Notifier>> notifiers_;
};

}  // namespace dssm::detail
