// SPDX-License-Identifier: Apache-2.0
//
// Writing to a mapped ring. Writers of one stream take turns by the robust lock in its header; a
// writer that dies at any instruction leaves the lock to the next one, who repairs what it needs,
// and a slot that no reader accepts.
#pragma once

#include <dssm/sample.hpp>
#include <span>

#include "core/ring/bell.hpp"
#include "core/ring/ring_memory.hpp"
#include "core/ring/slot_table.hpp"

namespace dssm::ring {

// One per writing thread; the mapping (read-write) and the bell outlive it.
class RingWriter {
 public:
  // doorbell: the stream's eventfd, rung while the bell says so; -1: none. Not owned.
  RingWriter(const RingMapping& mapping, Bell& bell, int doorbell) noexcept;

  // Writes one sample; payload.size() == payload_bytes. Returns its tid; kNoTid when this thread
  // holds the lock already (a loan).
  Tid write(std::span<const std::byte> payload, Time time, Duration clock_error) noexcept;

  // In place: begin() takes the lock and gives the next slot's payload (nullptr when this thread
  // holds it already); then exactly one of commit() and cancel(), in the same thread.
  std::byte* begin() noexcept;
  Tid commit(Time time, Duration clock_error) noexcept;
  void cancel() noexcept;

  Tid newest() const noexcept { return header_->top.load(std::memory_order_acquire); }

 private:
  bool lock() noexcept;
  void unlock() noexcept;
  void recover() noexcept;
  Tid publish(Time time, Duration clock_error) noexcept;
  void follow_up(Tid tid) noexcept;

  RingHeader* header_;
  SlotTable slots_;
  Bell* bell_;
  int doorbell_;
  bool large_;  // payload so large that memcpy may use non-temporal stores
};

}  // namespace dssm::ring
