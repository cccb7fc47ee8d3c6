// SPDX-License-Identifier: Apache-2.0
//
// clock_error_at() for a writer that stamps each sample: what the page states is kept until its
// generation changes. So the loads of one answer do not wait for each other, and it costs a few
// instructions that the processor does beside others (docs/benchmarks.md "Stamping").
#pragma once

#include <cstdint>
#include <dssm/time.hpp>

#include "core/clock/clock_page.hpp"

namespace dssm::clock {

// Of one thread.
class ClockErrorCache {
 public:
  // Whether `t` is not before the page's latest statement; then `error` is what clock_error_at()
  // returns, or some nanoseconds more. False: call that. page: nullptr: there is none.
  bool find(const ClockPage* page, Time t, Duration& error) noexcept {
    if (!page) return false;
    // Nearly always the same, so the processor goes on before it knows.
    if (page != page_ || page->state.generation() != generation_) {
      refresh(*page);
    }
    const std::uint64_t age =
        static_cast<std::uint64_t>(to_ns(t)) - static_cast<std::uint64_t>(wall_ns_);
    if (age > static_cast<std::uint64_t>(to_ns(kLongestUse))) return false;
    error = Duration(bound_ns_ + static_cast<std::int64_t>((age * growth_ + kRoundUp) >> 32));
    return true;
  }

 private:
  static constexpr std::uint64_t kRoundUp = (std::uint64_t{1} << 32) - 1;

  void refresh(const ClockPage& page) noexcept;

  const ClockPage* page_ = nullptr;
  std::uint64_t generation_ = 0;
  std::int64_t wall_ns_ = 0;
  std::int64_t bound_ns_ = 0;  // 2^63-1: none
  std::uint64_t growth_ = 0;   // of it, 2^-32 ns per ns
};

}  // namespace dssm::clock
