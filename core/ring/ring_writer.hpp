// SPDX-License-Identifier: Apache-2.0
//
// Writing to a mapped ring. Writers of one stream take turns by the robust lock in its header; a
// writer that dies at any instruction leaves the lock to the next one, who repairs what it needs,
// and a slot that no reader accepts.
#pragma once

#include <dssm/sample.hpp>
#include <span>

#include "core/ring/bell.hpp"
#include "core/ring/publisher_cursors.hpp"
#include "core/ring/ring_memory.hpp"
#include "core/ring/robust_lock.hpp"
#include "core/ring/sample_publisher.hpp"

namespace dssm::ring {

// One per writing thread; the mapping (read-write) and the bell outlive it.
class RingWriter {
 public:
  // doorbell: the stream's eventfd, rung while the bell says so; -1: none. Not owned.
  RingWriter(const RingMapping& mapping, Bell& bell, int doorbell) noexcept;

  // Writes one sample; payload.size() == payload_bytes. Returns its tid; kNoTid when this thread
  // holds the lock already (a loan).
  Tid write(std::span<const std::byte> payload, Time time, Duration clock_error) noexcept;

  // The same with a bound that has yet to be looked up: `clock_error()` is called once, with the
  // lock held, so that the processor waits for its loads while it copies the payload. Before the
  // lock, whose atomic operation waits for all that came before, it would cost what it takes.
  template <class LookUp>
  Tid write_with(std::span<const std::byte> payload, Time time, LookUp clock_error) noexcept {
    return lock() ? write_locked(payload, time, clock_error()) : kNoTid;
  }

  // Writes one sample for somebody on another PC and notes how far that one is by it
  // (PublisherCursors). Does not wait for another writer: dssmd's loop must not wait for a program.
  struct Attempt {
    enum class Outcome : unsigned char {
      written,
      busy,     // another writer is at it: try again soon
      refused,  // somebody has damaged the lock
    } outcome;
    Tid tid;
  };
  Attempt try_publish(const PublishedSample& sample, std::span<const std::byte> payload, Time time,
                      Duration clock_error) noexcept;

  // In place: begin() takes the lock and gives the next slot's payload (nullptr when this thread
  // holds it already); then exactly one of commit() and cancel(), in the same thread.
  std::byte* begin() noexcept;
  Tid commit(Time time, Duration clock_error) noexcept;
  void cancel() noexcept;

  Tid newest() const noexcept { return publisher_.newest(); }

 private:
  bool lock() noexcept;
  bool take(LockResult result) noexcept;
  void unlock() noexcept;
  Tid write_locked(std::span<const std::byte> payload, Time time, Duration clock_error) noexcept;
  void follow_up(Tid tid) noexcept;

  SamplePublisher publisher_;
  Bell* bell_;
  int doorbell_;
};

}  // namespace dssm::ring
