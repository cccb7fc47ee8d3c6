// SPDX-License-Identifier: Apache-2.0
//
// What a PConnector's subscription asks for, and where the bytes of the arriving sample go. Which
// sample comes next is SampleCursor's.
//
// A sample is received directly into the caller's memory (set_target), or into a queue while the
// program uses the connection for another request (set_buffering); otherwise it stays in the
// connection's input buffer, and the following ones in the owner's ring, until the program reads.
#pragma once

#include <cstddef>
#include <dssm/pconnector.hpp>
#include <dssm/result.hpp>
#include <dssm/sample.hpp>
#include <optional>
#include <span>
#include <vector>

#include "core/channel/channel_client.hpp"
#include "network.pb.h"

namespace dssm::detail {

// Samples that arrived while the program used the connection for another request: a circular buffer
// that grows up to a limit. Beyond it the oldest sample is removed, but only when its successor is
// complete: a sample that has arrived in part may still be cut off or torn. A value; one thread.
class SampleQueue {
 public:
  // max_bytes: of all payloads, each as long as the longest, but the one that is arriving; one
  // sample is always kept, however large.
  SampleQueue(std::size_t payload_bytes, std::size_t max_bytes);

  bool empty() const noexcept { return count_ == 0; }
  std::size_t size() const noexcept { return count_; }

  // Where the next sample's payload goes, until push() or another place().
  std::byte* place();
  // The payload at place() is complete. May drop the oldest sample: then dropped() rises.
  void push(const SampleInfo& info) noexcept;

  // Takes the oldest sample; not when empty.
  void pop(std::span<std::byte> payload, SampleInfo& info) noexcept;

  void clear() noexcept;
  std::uint64_t dropped() const noexcept { return dropped_; }
  // Samples removed from the queue so far: popped, dropped or cleared.
  std::uint64_t removed() const noexcept { return removed_; }

 private:
  std::size_t index(std::size_t n) const noexcept { return (first_ + n) % infos_.size(); }
  void grow();
  void remove_oldest() noexcept;

  std::size_t payload_bytes_, max_count_;
  std::vector<std::byte> payloads_;
  std::vector<SampleInfo> infos_;  // its size is the capacity
  std::size_t first_ = 0, count_ = 0;
  std::uint64_t dropped_ = 0, removed_ = 0;
};

// A value; one thread.
class Subscriber {
 public:
  // Of samples that arrive while the program waits for an answer, which takes a round trip. Samples
  // beyond it count as lost.
  static constexpr std::size_t kMaxBufferedBytes = 16U << 20;

  explicit Subscriber(std::size_t payload_bytes);

  // A subscription as the program requested it; it replaces any other.
  void begin(const Subscription& what);
  void end();
  bool active() const noexcept { return what_.has_value(); }
  // Whether on_subscribed_untrusted() came since begin().
  bool granted() const noexcept { return cursor_.next() != kNoTid; }

  // The request that begins it, or resumes it after a reconnect.
  void to_message(std::uint64_t incarnation, net::Subscribe& out) const;

  // --- what arrives

  // From now on samples belong to this subscription, the first one with tid `first`.
  Result<void> on_subscribed_untrusted(Tid first);
  Result<void> on_gap_untrusted(Tid first, std::uint64_t count);
  // The owner's ring was replaced; comes before on_subscribed_untrusted().
  void on_restart() noexcept;
  // The connection ended, and with it a sample that had arrived in part.
  void on_down() noexcept;

  // A sample begins: `out` is where it goes (nullptr: nowhere). False: it has to wait.
  Result<bool> on_sample_begin(const SampleInfo& info, std::byte*& out);
  void on_sample_end(const SampleInfo& info, bool torn) noexcept;

  // --- what the program reads

  // Whether samples without a target go to the queue.
  void set_buffering(bool on) noexcept { buffering_ = on; }
  // Where the next sample goes: all of its payload's bytes; nullptr: nowhere.
  void set_target(std::byte* target) noexcept { target_ = target; }
  // Whether a sample has arrived in the target; once.
  bool delivered(SampleInfo& info) noexcept;
  // Whether one has arrived there in part.
  bool is_filling_target() const noexcept { return arriving_ == Arriving::in_target; }
  // Where the sample that fills the target continues, because the caller needs the target back.
  std::byte* detach_target();

  bool has_buffered() const noexcept { return !queue_.empty() || is_restart_next(); }
  // From the queue: a sample, or `restarted`.
  std::optional<ReadStatus> pop_buffered(std::span<std::byte> payload, SampleInfo& info) noexcept;

  std::uint64_t lost() const noexcept { return cursor_.lost() + queue_.dropped(); }
  // Copied out of the queue.
  std::uint64_t copied_bytes() const noexcept { return copied_bytes_; }

 private:
  enum class Arriving : unsigned char { nothing, in_target, in_queue, nowhere };

  bool is_restart_next() const noexcept { return restart_at_ && *restart_at_ <= queue_.removed(); }

  std::optional<Subscription> what_;
  bool live_ = false;             // on this connection
  channel::SampleCursor cursor_;  // next() is known since the first connection
  std::uint64_t copied_bytes_ = 0;

  bool buffering_ = false;
  std::byte* target_ = nullptr;
  std::optional<SampleInfo> delivered_;
  Arriving arriving_ = Arriving::nothing;
  SampleQueue queue_;
  std::optional<std::uint64_t> restart_at_;  // report it when so many were removed from the queue
};

}  // namespace dssm::detail
