// SPDX-License-Identifier: Apache-2.0
#include "daemon/service/reloader.hpp"

#include <algorithm>
#include <string>
#include <string_view>

#include "daemon/base/message_ids.hpp"

namespace dssm::daemon {
namespace {

void add(std::string& list, std::string_view name) {
  list.append(list.empty() ? "" : ", ").append(name);
}

}  // namespace

void Reloader::reload() {
  const Result<Config> read = read_();
  if (!read) {
    std::string_view mistakes = read.error().message;
    while (!mistakes.empty()) {
      const std::string_view line = mistakes.substr(0, mistakes.find('\n'));
      logger_.error("reload: " + std::string(line) + "; everything stays as it was",
                    {.message_id = message_id::kReloadFailed});
      mistakes.remove_prefix(std::min(line.size() + 1, mistakes.size()));
    }
    return;
  }
  std::string changed, needs_restart;
  for (const ConfigKey& key : config_keys()) {
    if (key.change.at_once) {
      if (!key.change.is_same(*read, applied_)) add(changed, key.name);
    } else if (!key.change.is_same(*read, started_with_)) {
      add(needs_restart, key.name);
    }
  }
  applied_ = *read;
  apply_(applied_);
  logger_.notice("configuration read again: " +
                     (changed.empty() ? "nothing changed at once" : "changed " + changed),
                 {.message_id = message_id::kReloaded});
  if (needs_restart.empty()) return;
  logger_.warning(
      "the configuration differs from the one in use in keys that count from the next "
      "start on (systemctl restart dssmd): " +
          needs_restart,
      {.message_id = message_id::kRestartNeeded});
}

}  // namespace dssm::daemon
