// SPDX-License-Identifier: Apache-2.0
//
// One ring's share of max_streams, for a ring that is not in the Registry: a mirror's, a remote
// writer's. Held while the object exists.
#pragma once

#include <cstdint>
#include <utility>

namespace dssm::daemon {

class RingQuota {
 public:
  RingQuota() = default;
  explicit RingQuota(std::uint64_t& used) noexcept : used_(&used) { ++used; }  // outlives it
  RingQuota(RingQuota&& other) noexcept : used_(std::exchange(other.used_, nullptr)) {}
  RingQuota& operator=(RingQuota&& other) noexcept {
    std::swap(used_, other.used_);
    return *this;
  }
  ~RingQuota() {
    if (used_) --*used_;
  }

 private:
  std::uint64_t* used_ = nullptr;
};

}  // namespace dssm::daemon
