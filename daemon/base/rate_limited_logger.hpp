// SPDX-License-Identifier: Apache-2.0
//
// A logger that cannot be made to fill the log: what peers do can be repeated as often as they
// like. Of each level it passes kLinesPerPeriod lines on in a period, counts the others, and says
// how many they were with the first line of a later one.
#pragma once

#include <array>
#include <cstdint>
#include <dssm/time.hpp>
#include <functional>

#include "daemon/base/log.hpp"

namespace dssm::daemon {

class RateLimitedLogger final : public Logger {
 public:
  static constexpr int kLinesPerPeriod = 50;
  static constexpr Duration kPeriod = std::chrono::seconds(10);

  // to: outlives it. now: the clock; tests put their own in its place.
  explicit RateLimitedLogger(Logger& to, std::function<MonoTime()> now = MonoClock::now)
      : to_(to), now_(std::move(now)) {}

  void write(LogLevel level, std::string_view text, const LogFields& fields) noexcept override;

 private:
  struct Counter {
    MonoTime period_begin{};
    int passed = kLinesPerPeriod;  // so that the first line begins a period
    std::uint64_t left_out = 0;
  };
  Logger& to_;
  std::function<MonoTime()> now_;
  std::array<Counter, static_cast<std::size_t>(LogLevel::debug) + 1> counters_{};
};

}  // namespace dssm::daemon
