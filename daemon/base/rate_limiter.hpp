// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>
#include <cstdint>
#include <dssm/time.hpp>
#include <optional>
#include <utility>

namespace dssm::daemon {

// Limits how often something happens: a burst of `at_once`, then one per `period`; while nothing
// happens, the burst is restored at the same rate. (The generic cell rate algorithm, ITU-T I.371:
// one time is its whole state.)
//
// For log lines, admit() also counts what was left out:
//
//   if (const auto lost = gap_lines_.admit(now, samples)) logger.warning(... *lost ...);
class RateLimiter {
 public:
  RateLimiter(int at_once, Duration period) : period_(period), ahead_((at_once - 1) * period) {}

  // Time until the next one may happen; zero: now.
  Duration wait(MonoTime now) const { return std::max(Duration::zero(), due_ - ahead_ - now); }
  // One happens. Only when wait() is zero.
  void take(MonoTime now) { due_ = std::max(due_, now) + period_; }

  // Adds `amount` to a sum. When one may happen now: takes it, returns the sum and resets it.
  std::optional<std::uint64_t> admit(MonoTime now, std::uint64_t amount = 1) {
    sum_ += amount;
    if (wait(now) > Duration::zero()) return std::nullopt;
    take(now);
    return std::exchange(sum_, 0);
  }

 private:
  Duration period_, ahead_;
  MonoTime due_{};
  std::uint64_t sum_ = 0;
};

}  // namespace dssm::daemon
