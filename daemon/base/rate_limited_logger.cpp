// SPDX-License-Identifier: Apache-2.0
#include "daemon/base/rate_limited_logger.hpp"

#include <string>
#include <utility>

namespace dssm::daemon {

void RateLimitedLogger::write(LogLevel level, std::string_view text,
                              const LogFields& fields) noexcept {
  Counter& counter = counters_[static_cast<std::size_t>(level)];
  if (counter.passed == kLinesPerPeriod) {
    const MonoTime now = now_();
    if (counter.period_begin != MonoTime() && now - counter.period_begin < kPeriod) {
      ++counter.left_out;
      return;
    }
    counter.period_begin = now;
    counter.passed = 0;
  }
  ++counter.passed;
  const std::uint64_t left_out = std::exchange(counter.left_out, 0);
  if (left_out == 0) return to_.write(level, text, fields);
  to_.write(level,
            std::string(text) + " (" + std::to_string(left_out) +
                " lines about other hosts before this one were left out)",
            fields);
}

}  // namespace dssm::daemon
