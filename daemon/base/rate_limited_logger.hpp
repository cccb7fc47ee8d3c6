// SPDX-License-Identifier: Apache-2.0
//
// A logger that peers cannot use to fill the log. Of each level it passes at most kLinesPerPeriod
// lines on at once and in each period on average; the next line gives the number of lines that were
// left out.
#pragma once

#include <dssm/time.hpp>
#include <functional>
#include <vector>

#include "daemon/base/log.hpp"
#include "daemon/base/rate_limiter.hpp"

namespace dssm::daemon {

class RateLimitedLogger final : public Logger {
 public:
  static constexpr int kLinesPerPeriod = 50;
  static constexpr Duration kPeriod = std::chrono::seconds(10);

  // `to` outlives this object. `now` is the clock; tests pass their own.
  explicit RateLimitedLogger(Logger& to, std::function<MonoTime()> now = MonoClock::now)
      : to_(to), now_(std::move(now)) {}

  void write(LogLevel level, std::string_view text, const LogFields& fields) noexcept override;

 private:
  Logger& to_;
  std::function<MonoTime()> now_;
  std::vector<RateLimiter> limiters_{// by level
                                     static_cast<std::size_t>(LogLevel::debug) + 1,
                                     RateLimiter(kLinesPerPeriod, kPeriod / kLinesPerPeriod)};
};

}  // namespace dssm::daemon
