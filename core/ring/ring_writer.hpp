// SPDX-License-Identifier: Apache-2.0
//
// Writing to a mapped ring. The classes between a program's call and the memory:
//
//   Writer<T>   (client/include/dssm)  a typed sample
//   RawWriter   (client/include/dssm)  its bytes, and the clock error of its time
//   RingWriter                         the lock, and the wake-up of readers and dssmd
//   SlotWriter                         the slot, the time index, `top`
//
// In a mirror, MirrorRing (daemon/remote) takes the place of RingWriter: dssmd is the only writer
// and needs no lock. OutgoingRing is a ring that programs fill like any other and that dssmd reads.
//
// Writers of one stream take turns by the robust lock in its header. A writer that dies at any
// instruction leaves a slot that no reader accepts, and the lock to the next writer, which repairs
// what the dead one left.
#pragma once

#include <dssm/sample.hpp>
#include <span>

#include "core/ring/bell.hpp"
#include "core/ring/publisher_cursors.hpp"
#include "core/ring/ring_memory.hpp"
#include "core/ring/slot_writer.hpp"

namespace dssm::ring {

// One per writing thread; the mapping (read-write) and the bell outlive it.
class RingWriter {
 public:
  // doorbell: this program's eventfd, written to while dssmd has armed the ring's doorbells; -1:
  // none. Not owned.
  RingWriter(const RingMapping& mapping, Bell& bell, int doorbell) noexcept;

  // Writes one sample of at most the stream's payload_bytes. Returns its tid; kNoTid when this
  // thread holds the lock already (a loan), or did not get it (RobustLock::kMaxWait).
  Tid write(std::span<const std::byte> payload, Time time, Duration clock_error) noexcept;

  // The same with a clock error that is still to be found: `clock_error()` is called once, with the
  // lock held, so that its loads overlap with the copy of the payload. Before the lock they would
  // add their whole latency, because the lock's atomic operation waits for all earlier loads.
  template <class LookUp>
  Tid write_with(std::span<const std::byte> payload, Time time, LookUp clock_error) noexcept {
    return lock() ? write_locked(payload, time, clock_error()) : kNoTid;
  }

  // Writes one sample for a publisher on another PC and advances its cursor (PublisherCursors).
  // Does not wait for another writer: dssmd's loop must not wait for a program.
  //   returns  its tid; kNoTid when another writer has the lock: try again soon
  Tid try_publish(const PublishedSample& sample, std::span<const std::byte> payload, Time time,
                  Duration clock_error) noexcept;

  // In place: begin() takes the lock and gives the next slot's payload (nullptr when write() would
  // fail); then exactly one of commit() and cancel(), in the same thread.
  std::byte* begin() noexcept;
  Tid commit(std::size_t payload_bytes, Time time, Duration clock_error) noexcept;
  void cancel() noexcept;

  Tid newest() const noexcept { return slots_.newest(); }

 private:
  bool lock() noexcept;
  bool take(LockResult result) noexcept;
  Tid write_locked(std::span<const std::byte> payload, Time time, Duration clock_error) noexcept;
  void follow_up(Tid tid) noexcept;

  SlotWriter slots_;
  const RobustLock* lock_;
  Bell* bell_;
  int doorbell_;
};

}  // namespace dssm::ring
