// SPDX-License-Identifier: Apache-2.0
//
// The memory that rings and properties may take, all together (key max_memory). A stream's share is
// given back when its last user releases it, not when its name disappears: a removed ring that a
// program still holds still takes memory.
#pragma once

#include <fmt/format.h>

#include <cstdint>
#include <dssm/result.hpp>
#include <optional>
#include <utility>

namespace dssm::daemon {

// For a connection that ends because the system has no memory for what it asked.
inline Error no_memory_left() {
  return {Errc::no_memory, "dssmd has no memory left for this connection; try again later"};
}

class MemoryBudget;

// A share of a budget; given back by the destructor. The budget outlives it.
class MemoryShare {
 public:
  MemoryShare() = default;
  MemoryShare(MemoryShare&& other) noexcept
      : budget_(other.budget_), bytes_(std::exchange(other.bytes_, 0)) {}
  MemoryShare& operator=(MemoryShare&& other) noexcept {
    if (this != &other) {
      give_back();
      budget_ = other.budget_;
      bytes_ = std::exchange(other.bytes_, 0);
    }
    return *this;
  }
  ~MemoryShare() { give_back(); }

  std::uint64_t bytes() const noexcept { return bytes_; }

 private:
  friend class MemoryBudget;
  MemoryShare(MemoryBudget& budget, std::uint64_t bytes) : budget_(&budget), bytes_(bytes) {}
  inline void give_back() noexcept;
  MemoryBudget* budget_ = nullptr;
  std::uint64_t bytes_ = 0;
};

class MemoryBudget {
 public:
  explicit MemoryBudget(std::uint64_t limit_bytes) : limit_(limit_bytes) {}
  MemoryBudget(const MemoryBudget&) = delete;
  MemoryBudget& operator=(const MemoryBudget&) = delete;

  // Fails with limit_exceeded, naming the key and what is left.
  Result<MemoryShare> take(std::uint64_t bytes) {
    if (bytes <= left()) {
      used_ += bytes;
      return MemoryShare(*this, bytes);
    }
    return Error{
        Errc::limit_exceeded,
        fmt::format("{} bytes of memory are needed and {} are left of max_memory = {} bytes; keep "
                    "less history, remove streams (dssmctl rm), or raise the key max_memory",
                    bytes, left(), limit_)};
  }

  // The same for callers with their own error, or another way, when it is used up.
  std::optional<MemoryShare> try_take(std::uint64_t bytes) noexcept {
    if (bytes > left()) return std::nullopt;
    used_ += bytes;
    return MemoryShare(*this, bytes);
  }

  std::uint64_t used() const noexcept { return used_; }
  std::uint64_t limit() const noexcept { return limit_; }

  // Nothing is taken back: below what is used, nothing more is given.
  void set_limit(std::uint64_t limit_bytes) noexcept { limit_ = limit_bytes; }

 private:
  friend class MemoryShare;
  std::uint64_t left() const noexcept { return limit_ > used_ ? limit_ - used_ : 0; }
  std::uint64_t limit_;
  std::uint64_t used_ = 0;
};

inline void MemoryShare::give_back() noexcept {
  if (budget_) budget_->used_ -= std::exchange(bytes_, 0);
}

}  // namespace dssm::daemon
