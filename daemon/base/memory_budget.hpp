// SPDX-License-Identifier: Apache-2.0
//
// The memory that rings and properties may take, all together (key max_memory) and for each account
// (key max_share). A stream's share is given back when its last user releases it, not when its name
// disappears: a removed ring that a program still holds still takes memory.
#pragma once

#include <fmt/format.h>

#include <algorithm>
#include <cstdint>
#include <dssm/result.hpp>
#include <map>
#include <new>
#include <optional>
#include <string>
#include <utility>

#include "daemon/base/limit_use.hpp"

namespace dssm::daemon {

// For a connection that ends because the system has no memory for what it asked.
inline Error no_memory_left() {
  return {Errc::no_memory, "dssmd has no memory left for this connection; try again later"};
}

// Calls `then` with what `make` returns; with no_memory when either of them finds none: others wait
// for their answers behind this one.
template <class Then, class Make>
void answer_with(const Then& then, Make make) {
  try {
    then(make());
  } catch (const std::bad_alloc&) {
    then(no_memory_left());
  }
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
  // What `account` may take of `all`, which outlives it: counts in both.
  MemoryBudget(std::uint64_t limit_bytes, MemoryBudget& all, std::string account)
      : limit_(limit_bytes), all_(&all), account_(std::move(account)) {}
  MemoryBudget(const MemoryBudget&) = delete;
  MemoryBudget& operator=(const MemoryBudget&) = delete;

  // Fails with limit_exceeded, naming the key and what is left.
  Result<MemoryShare> take(std::uint64_t bytes) {
    if (std::optional<MemoryShare> share = try_take(bytes)) return *std::move(share);
    if (all_ && bytes > all_->left()) return all_->take(bytes);
    if (all_) {
      return Error{
          Errc::limit_exceeded,
          fmt::format("{} bytes of memory are needed and {} are left of the {} that {} may take of "
                      "max_memory; keep less history, remove streams (dssmctl rm), or raise the "
                      "key max_share",
                      bytes, left(), limit_, account_)};
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
    for (MemoryBudget* one = this; one; one = one->all_) one->used_ += bytes;
    return MemoryShare(*this, bytes);
  }

  std::uint64_t used() const noexcept { return used_; }
  std::uint64_t limit() const noexcept { return limit_; }

  // From now on it counts in `all`, which outlives it (nullptr: in none), with what is used.
  void move_to(MemoryBudget* all) noexcept {
    if (all_ == all) return;
    if (all_) all_->used_ -= used_;
    all_ = all;
    if (all_) all_->used_ += used_;
  }

  // Of all accounts together; 0: there is no such limit.
  std::uint64_t limit_of_all() const noexcept { return all_ ? all_->limit() : 0; }

  // Nothing is taken back: below what is used, nothing more is given.
  void set_limit(std::uint64_t limit_bytes) noexcept { limit_ = limit_bytes; }

 private:
  friend class MemoryShare;
  std::uint64_t left() const noexcept {
    const std::uint64_t own = limit_ > used_ ? limit_ - used_ : 0;
    return all_ ? std::min(own, all_->left()) : own;
  }
  std::uint64_t limit_;
  std::uint64_t used_ = 0;
  MemoryBudget* all_ = nullptr;
  const std::string account_;
};

// What a peer's memory may be, for errors.
inline std::string peer_memory(const MemoryBudget& budget) {
  std::string text = fmt::format("max_peer_memory = {} bytes", budget.limit());
  if (const std::uint64_t all = budget.limit_of_all()) {
    text += fmt::format(", or the {} that all peers may use together,", all);
  }
  return text;
}

inline void MemoryShare::give_back() noexcept {
  const std::uint64_t bytes = std::exchange(bytes_, 0);
  if (bytes == 0) return;  // an account that has nothing may be gone
  for (MemoryBudget* one = budget_; one; one = one->all_) one->used_ -= bytes;
}

// A budget, and of it one for each account, so that one user cannot take it all.
class MemoryBudgets {
 public:
  MemoryBudgets(std::uint64_t limit_bytes, MaxShare max_share)
      : total_(limit_bytes), max_share_(max_share) {}

  MemoryBudget& total() noexcept { return total_; }
  const MemoryBudget& total() const noexcept { return total_; }

  // As Identity::account(); empty: without a limit of its own. Valid until the next call, and while
  // something is taken of it.
  MemoryBudget& of(const std::string& account) {
    if (account.empty()) return total_;
    if (const auto found = accounts_.find(account); found != accounts_.end()) return found->second;
    std::erase_if(accounts_, [](const auto& entry) { return entry.second.used() == 0; });
    return accounts_.try_emplace(account, max_share_.of(total_.limit()), total_, account)
        .first->second;
  }

  // By the account with the most.
  std::uint64_t most_used() const noexcept {
    std::uint64_t most = 0;
    for (const auto& [account, budget] : accounts_) most = std::max(most, budget.used());
    return most;
  }

  void set_limit(std::uint64_t limit_bytes, MaxShare max_share) {
    total_.set_limit(limit_bytes);
    max_share_ = max_share;
    for (auto& [account, budget] : accounts_) budget.set_limit(max_share.of(limit_bytes));
  }

 private:
  MemoryBudget total_;
  MaxShare max_share_;
  std::map<std::string, MemoryBudget> accounts_;
};

}  // namespace dssm::daemon
