// SPDX-License-Identifier: Apache-2.0
//
// Samples of a subscription that arrived while the program used the connection for another request:
// a circular buffer that grows up to a limit. Beyond it the oldest sample is removed, but only when
// its successor is complete: a sample that has arrived in part may still be cut off or torn.
#pragma once

#include <cstddef>
#include <dssm/sample.hpp>
#include <span>
#include <vector>

namespace dssm::detail {

// A value; one thread.
class SampleQueue {
 public:
  // max_bytes: of all payloads but the one that is arriving; one sample is always kept, however
  // large.
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

}  // namespace dssm::detail
