// SPDX-License-Identifier: Apache-2.0
//
// Samples on their way to another host's stream, kept as complete frames from post() until the
// owner acknowledges that they are written, so that a new connection can send again what the old
// one lost. Samples are numbered 0, 1, 2 ... as they are posted.
//
//   first ........ send ........ next       numbers
//     sent, not      waiting
//     acknowledged   to be sent
//
// A frame has room for the longest sample; a shorter one is followed by unused bytes.
//
// Bounded: when it is full, the oldest sample is removed. One that was never sent counts as
// dropped; one that was sent is probably written: the next acknowledgement or connection shows it.
#pragma once

#include <cstddef>
#include <cstdint>
#include <deque>
#include <dssm/result.hpp>
#include <dssm/sample.hpp>
#include <span>
#include <vector>

namespace dssm::detail {

// A value; one thread.
class Outbox {
 public:
  // Dropped samples that were sent, in ranges. Only an owner that receives samples and acknowledges
  // none causes so many; the oldest then count as written.
  static constexpr std::size_t kMaxUnackedRanges = 1024;

  // max_bytes: of all payloads, each as long as the longest; one sample is always kept, however
  // large.
  Outbox(std::size_t payload_bytes, std::uint64_t max_samples, std::uint64_t max_bytes);

  // Keeps the sample, of at most payload_bytes, to be sent; returns its number.
  std::int64_t push(std::span<const std::byte> payload, Time time, Duration clock_error);

  // Bytes to be sent next: consecutive frames, the first one perhaps sent in part; may be empty.
  // More may be unsent than these.
  std::span<const std::byte> unsent() const noexcept;
  // Of unsent(), only the rest of a frame that was sent in part.
  std::span<const std::byte> rest_of_frame() const noexcept;
  // So many bytes from the start of unsent() or rest_of_frame() were sent.
  void sent(std::size_t bytes) noexcept;

  // All up to this number are written; `tid` is the tid of the newest of them.
  //   fails  protocol (a number that was never posted)
  Result<void> acknowledge(std::int64_t last, Tid tid);
  // The connection ended: nothing is sent before restart().
  void on_down() noexcept;
  // A new connection is up, and the owner has written all up to this number.
  //   fails  as acknowledge()
  Result<void> restart(std::int64_t last, Tid tid);

  std::int64_t newest() const noexcept { return next_ - 1; }           // -1: nothing was posted
  bool all_written() const noexcept { return written_ == next_ - 1; }  // or dropped
  Tid written_tid() const noexcept { return written_tid_; }
  std::uint64_t dropped() const noexcept { return dropped_; }

 private:
  std::byte* place(std::int64_t number) noexcept;
  std::span<const std::byte> frame(std::int64_t number) const noexcept;
  void make_space();
  void drop_oldest();
  void detach_begun_frame();

  std::size_t payload_bytes_, most_frame_bytes_;
  std::int64_t max_count_, capacity_ = 0;  // frames
  std::vector<std::byte> frames_;          // frame `number` at number % capacity_
  std::vector<std::size_t> frame_bytes_;   // its length, likewise
  std::vector<std::byte> begun_;           // rest of a frame that was sent in part and then removed
  std::int64_t first_ = 0, send_ = 0, next_ = 0;
  std::size_t sent_of_send_ = 0;  // bytes of frame `send_` that were sent
  struct Range {
    std::int64_t from, to;  // without `to`
  };
  std::deque<Range> unacked_dropped_;  // sent, then removed, perhaps not written; ascending
  std::int64_t written_ = -1;
  Tid written_tid_ = kNoTid;
  std::uint64_t dropped_ = 0;
};

}  // namespace dssm::detail
