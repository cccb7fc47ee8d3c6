// SPDX-License-Identifier: Apache-2.0
#include "daemon/clock/host_clock_log.hpp"

#include "core/base/text.hpp"
#include "daemon/base/message_ids.hpp"

namespace dssm::daemon {

void HostClockLog::update(const wire::HostId& id, const std::string& name,
                          const std::string& reason, MonoTime now) {
  Seen& seen = hosts_[id];
  const bool is_good = reason.empty();
  if (is_good) {
    seen.bad_since.reset();
    seen.was_good = true;
  } else if (!seen.bad_since) {
    seen.bad_since = now;
  }
  const bool is_due = seen.was_good || (seen.bad_since && now - *seen.bad_since >= kStartupDelay);
  // A change that is reverted while the log is limited is left out; one that lasts is logged later.
  if (is_good != seen.logged_bad || !is_due || seen.pace.wait(now) > Duration::zero()) return;
  seen.pace.take(now);
  seen.logged_bad = !is_good;
  if (is_good) {
    return logger_.notice("the times of " + in_quotes(name) + "'s samples are good here again",
                          {.message_id = message_id::kHostClockInBounds});
  }
  logger_.warning("the times of " + in_quotes(name) + "'s samples are not good here: " + reason,
                  {.message_id = message_id::kHostClockOutOfBounds});
}

bool HostClockLog::is_changed(const wire::HostId& id, bool is_good) const {
  const auto found = hosts_.find(id);
  return found != hosts_.end() && found->second.logged_bad == is_good &&
         (is_good || found->second.was_good);
}

void HostClockLog::forget(const wire::HostId& id) {
  const auto found = hosts_.find(id);
  if (found == hosts_.end()) return;
  Seen& seen = found->second;
  if (!seen.logged_bad || hosts_.size() > kMaxHosts) {
    hosts_.erase(found);
    return;
  }
  seen.was_good = false;
  seen.bad_since.reset();
}

}  // namespace dssm::daemon
