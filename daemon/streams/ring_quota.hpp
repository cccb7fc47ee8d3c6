// SPDX-License-Identifier: Apache-2.0
//
// A place under max_streams for a ring without a name in the Registry: a mirror's, a remote
// writer's. Counted while the object lives.
#pragma once

#include <cstdint>
#include <utility>

namespace dssm::daemon {

class RingQuota {
 public:
  RingQuota() = default;
  explicit RingQuota(std::uint64_t& taken) noexcept : taken_(&taken) { ++taken; }  // outlives it
  RingQuota(RingQuota&& other) noexcept : taken_(std::exchange(other.taken_, nullptr)) {}
  RingQuota& operator=(RingQuota&& other) noexcept {
    std::swap(taken_, other.taken_);
    return *this;
  }
  ~RingQuota() {
    if (taken_) --*taken_;
  }

 private:
  std::uint64_t* taken_ = nullptr;
};

}  // namespace dssm::daemon
