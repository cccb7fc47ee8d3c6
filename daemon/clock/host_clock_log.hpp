// SPDX-License-Identifier: Apache-2.0
//
// Logs when reads by time refuse another host's samples because of its clock, and when they deliver
// them again. One entry per host, however many of its streams are read here.
#pragma once

#include <dssm/time.hpp>
#include <map>
#include <optional>
#include <string>

#include "core/wire/network_protocol.hpp"
#include "daemon/base/log.hpp"
#include "daemon/base/rate_limiter.hpp"

namespace dssm::daemon {

class HostClockLog {
 public:
  // Before it logs a host whose clock was never good: it may just have started.
  static constexpr Duration kStartupDelay = std::chrono::seconds(30);

  // The logger outlives it.
  explicit HostClockLog(Logger& logger) noexcept : logger_(logger) {}

  // reason: why the times of its samples are not good here; empty: they are.
  void update(const wire::HostId& id, const std::string& name, const std::string& reason,
              MonoTime now);
  // Whether update() may log that at once: it is not what was logged last.
  bool is_changed(const wire::HostId& id, bool is_good) const;
  // It is not connected any more, which is logged elsewhere. What was logged as bad is logged when
  // it is good again.
  void forget(const wire::HostId& id);

 private:
  struct Seen {
    bool was_good = false;
    bool logged_bad = false;
    std::optional<MonoTime> bad_since;  // nothing: it is good
    RateLimiter pace{4, std::chrono::minutes(1)};
  };

  // So many that are kept although they left.
  static constexpr std::size_t kMaxHosts = 256;

  Logger& logger_;
  std::map<wire::HostId, Seen> hosts_;
};

}  // namespace dssm::daemon
