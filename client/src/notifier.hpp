// SPDX-License-Identifier: Apache-2.0
//
// Pollable descriptors for readers. Writers wake sleepers through futexes, which poll() does not
// know; a notifier thread sleeps on behalf of up to kMaxWatched readers and rings an eventfd for
// each that has news. It needs no dssmd.
#pragma once

#include <atomic>
#include <dssm/sample.hpp>
#include <memory>
#include <mutex>
#include <thread>
#include <vector>

#include "client/src/shared_ring.hpp"
#include "core/ring/bell.hpp"
#include "core/ring/ring_reader.hpp"

namespace dssm::detail {

// The ring that a reader's descriptor speaks of.
struct ReadyRing {
  std::shared_ptr<const SharedRing> ring;
  std::shared_ptr<const std::atomic<bool>> superseded;  // by another ring
  Tid seen = kNoTid;                                    // news is what is newer
};

// A reader's descriptor. Readable when the ring's newest tid rose since the last clear(), or when
// the ring was superseded. Thread-safe.
class ReadyFd {
 public:
  ReadyFd(ReadyRing ring, UniqueFd event) : ring_(std::move(ring)), event_(std::move(event)) {}

  int fd() const noexcept { return event_.get(); }
  void clear() noexcept;

 private:
  friend class Notifier;
  friend class NotifierPool;
  std::shared_ptr<const SharedRing> ring();
  bool look() noexcept;  // rings when there is news
  void follow(ReadyRing ring);

  std::mutex mutex_;  // guards ring_ and told_
  ReadyRing ring_;
  bool told_superseded_ = false;
  UniqueFd event_;
};

// One thread and the readers it sleeps for. Thread-safe.
class Notifier {
 public:
  static constexpr std::size_t kMaxWatched = 127;  // of futex_waitv's 128 one is our own

  static Result<std::unique_ptr<Notifier>> start();
  ~Notifier();

  // False when it has no room.
  bool add(const std::shared_ptr<ReadyFd>& ready);
  void look_again() noexcept { control_->notify(); }

 private:
  Notifier() = default;
  void run();

  std::shared_ptr<ring::Bell> control_;  // rung when the list changes
  std::mutex mutex_;
  std::vector<std::weak_ptr<ReadyFd>> watched_;
  bool stopping_ = false;
  std::thread thread_;
};

// As many notifiers as are needed. Thread-safe.
class NotifierPool {
 public:
  Result<std::shared_ptr<ReadyFd>> watch(ReadyRing ring);
  // From now on `ready` speaks of another ring.
  void follow(ReadyFd& ready, ReadyRing ring);

 private:
  std::mutex mutex_;
  std::vector<std::unique_ptr<Notifier>> notifiers_;
};

}  // namespace dssm::detail
