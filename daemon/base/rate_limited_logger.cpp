// SPDX-License-Identifier: Apache-2.0
#include "daemon/base/rate_limited_logger.hpp"

#include <fmt/format.h>

namespace dssm::daemon {

void RateLimitedLogger::write(LogLevel level, std::string_view text,
                              const LogFields& fields) noexcept {
  const auto lines = limiters_[static_cast<std::size_t>(level)].admit(now_());
  if (!lines) return;
  if (*lines == 1) return to_.write(level, text, fields);
  to_.write(level,
            fmt::format("{} ({} lines about other hosts before this one were left out)", text,
                        *lines - 1),
            fields);
}

}  // namespace dssm::daemon
