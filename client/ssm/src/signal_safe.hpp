// SPDX-License-Identifier: Apache-2.0
//
// Beside signal handlers: programs read and write streams in them, and end waits by them.
#pragma once

#include <poll.h>
#include <unistd.h>

#include <atomic>
#include <cerrno>
#include <dssm/playback_clock.hpp>

#include "core/base/quiet_thread.hpp"
#include "core/base/time.hpp"

namespace dssm::ssm {

// The kernel's id of this thread, asked once per thread.
extern constinit thread_local int kept_thread_id;
int ask_thread_id() noexcept;  // and keeps it
inline int this_thread_id() noexcept {
  const int kept = kept_thread_id;
  return kept != 0 ? kept : ask_thread_id();
}

// A lock that its holder may take again: a handler that interrupts its own thread in a read must
// not block, as it did not in the old library, which had no lock there.
//
//   signals  may be locked and unlocked in a handler
//   fork     reset_after_fork() frees it in the child, where its holder may not exist
class ReentrantLock {
 public:
  void lock() noexcept {
    const int me = this_thread_id();
    if (owner_.load(std::memory_order_relaxed) == me) {  // only this thread stores its own id
      ++depth_;
      return;
    }
    for (int owner = 0; !owner_.compare_exchange_weak(owner, me, std::memory_order_acquire);) {
      if (owner != 0) owner_.wait(owner, std::memory_order_relaxed);
      owner = 0;
    }
    depth_ = 1;
  }

  void unlock() noexcept {
    if (--depth_ > 0) return;
    owner_.store(0, std::memory_order_release);
    owner_.notify_one();
  }

  void reset_after_fork() noexcept {
    owner_.store(0, std::memory_order_relaxed);
    depth_ = 0;
  }

 private:
  std::atomic<int> owner_{0};
  int depth_ = 0;  // owner only
};

// Holds the lock, unless nothing needs it because this thread is alone with what it guards.
class LockUnlessAlone {
 public:
  LockUnlessAlone(ReentrantLock& lock, bool alone) noexcept : lock_(alone ? nullptr : &lock) {
    if (lock_) lock_->lock();
  }
  LockUnlessAlone(const LockUnlessAlone&) = delete;
  LockUnlessAlone& operator=(const LockUnlessAlone&) = delete;
  ~LockUnlessAlone() {
    if (lock_) lock_->unlock();
  }

 private:
  ReentrantLock* const lock_;
};

// Waits in a loop until something succeeds or the person presses Ctrl-C. Blocks signals except in
// pause(), so that none is missed between two checks.
class Interruptible {
 public:
  // Sleeps for `time`. False: a signal handler ran.
  bool pause(Duration time) noexcept {
    // There signals stay blocked until its turn has come.
    if (sleep_in_lockstep(time)) time = Duration::zero();
    const timespec sleep = timespec_of(time);
    return !(::ppoll(nullptr, 0, &sleep, &block_.before()) < 0 && errno == EINTR);
  }

 private:
  SignalBlock block_;
};

}  // namespace dssm::ssm
