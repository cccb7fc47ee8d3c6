// SPDX-License-Identifier: Apache-2.0
//
// error_at() for who asks again and again: what the page said is kept until it says something else.
// So the loads of one answer do not wait for each other, and it costs a few instructions that the
// processor does beside others (docs/benchmarks.md "Stamping").
#pragma once

#include <cstdint>
#include <dssm/time.hpp>

#include "core/clock/clock_page.hpp"

namespace dssm::clock {

// Of one thread.
class ErrorCache {
 public:
  // Whether `t` lies behind what the page says now; then `error` is what error_at() returns, or
  // some nanoseconds more. False: ask that. nullptr: there is no page.
  bool find(const ClockPage* page, Time t, Duration& error) noexcept {
    if (!page) return false;
    // Nearly always the same, so the processor goes on before it knows.
    if (page != page_ || page->generation.load(std::memory_order_acquire) != generation_) {
      look(*page);
    }
    const std::uint64_t age =
        static_cast<std::uint64_t>(to_ns(t)) - static_cast<std::uint64_t>(wall_ns_);
    if (age > static_cast<std::uint64_t>(to_ns(kLongestUse))) return false;
    error = Duration(bound_ns_ + static_cast<std::int64_t>((age * growth_ + kRoundUp) >> 32));
    return true;
  }

 private:
  static constexpr std::uint64_t kRoundUp = (std::uint64_t{1} << 32) - 1;

  void look(const ClockPage& page) noexcept;

  const ClockPage* page_ = nullptr;
  std::uint64_t generation_ = 0;
  std::int64_t wall_ns_ = 0;
  std::int64_t bound_ns_ = 0;  // 2^63-1: none
  std::uint64_t growth_ = 0;   // of it, 2^-32 ns per ns
};

}  // namespace dssm::clock
