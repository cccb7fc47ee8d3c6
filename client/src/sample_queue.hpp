// SPDX-License-Identifier: Apache-2.0
//
// Samples of a subscription that came while their reader was busy with something else: a circular
// buffer of equal entries in one piece of memory, which grows as it fills and is then used again
// and again. Bounded: beyond its limit the oldest samples go, each when its successor is complete
// and not before: what has begun to come may be cut off, or void.
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

  // Where the next sample's payload goes, until it is pushed or given up by another call of this.
  std::byte* place();
  // The payload at place() is complete. May drop the oldest sample: then dropped() rises.
  void push(const SampleInfo& info) noexcept;

  // Takes the oldest sample; not when empty.
  void pop(std::span<std::byte> payload, SampleInfo& info) noexcept;

  void clear() noexcept;
  std::uint64_t dropped() const noexcept { return dropped_; }
  // How many samples left the queue so far, by whatever way.
  std::uint64_t gone() const noexcept { return gone_; }

 private:
  std::size_t index(std::size_t n) const noexcept { return (first_ + n) % infos_.size(); }
  void grow();
  void remove_oldest() noexcept;

  std::size_t payload_bytes_, max_count_;
  std::vector<std::byte> payloads_;
  std::vector<SampleInfo> infos_;  // its size is how many samples there is room for
  std::size_t first_ = 0, count_ = 0;
  std::uint64_t dropped_ = 0, gone_ = 0;
};

}  // namespace dssm::detail
