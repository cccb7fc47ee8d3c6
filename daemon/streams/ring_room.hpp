// SPDX-License-Identifier: Apache-2.0
//
// A place under max_streams for a ring without a name in the Registry: a mirror's, a remote
// writer's. Counted while the object lives.
#pragma once

#include <cstdint>
#include <utility>

namespace dssm::daemon {

class RingRoom {
 public:
  RingRoom() = default;
  explicit RingRoom(std::uint64_t& taken) noexcept : taken_(&taken) { ++taken; }  // outlives it
  RingRoom(RingRoom&& other) noexcept : taken_(std::exchange(other.taken_, nullptr)) {}
  RingRoom& operator=(RingRoom&& other) noexcept {
    std::swap(taken_, other.taken_);
    return *this;
  }
  ~RingRoom() {
    if (taken_) --*taken_;
  }

 private:
  std::uint64_t* taken_ = nullptr;
};

}  // namespace dssm::daemon
