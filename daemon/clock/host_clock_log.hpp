// SPDX-License-Identifier: Apache-2.0
//
// Tells the log when samples of another host are refused by time because of its clock, and when
// they are taken again. One entry per host, however many of its streams are read here.
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
  // A host whose clock was never good: it may just have started.
  static constexpr Duration kPatience = std::chrono::seconds(30);

  // The logger outlives it.
  explicit HostClockLog(Logger& logger) noexcept : logger_(logger) {}

  // How it is now. trouble: why its samples' times are not good here; empty: they are.
  void look(const wire::HostId& id, const std::string& name, const std::string& trouble,
            MonoTime now);
  // It is gone, which the log says elsewhere.
  void forget(const wire::HostId& id) { hosts_.erase(id); }

 private:
  struct Seen {
    bool was_good = false;
    bool told = false;                  // that it is not good
    std::optional<MonoTime> bad_since;  // nothing: it is good
    RateLimiter pace{4, std::chrono::minutes(1)};
  };

  Logger& logger_;
  std::map<wire::HostId, Seen> hosts_;
};

}  // namespace dssm::daemon
