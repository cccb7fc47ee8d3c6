// SPDX-License-Identifier: Apache-2.0
//
// How much of a limit is used, for people: `dssmctl info` shows it. Each part of dssmd adds its own
// limits to a list; docs/limits.md lists all limits.
#pragma once

#include <sys/types.h>
#include <unistd.h>

#include <cstdint>
#include <string_view>
#include <vector>

namespace dssm::daemon {

struct LimitUse {
  std::string_view name;   // of the key, "max_streams", or of what is limited
  std::uint64_t used = 0;  // of a limit for each user, program or host: by the one with the most
  std::uint64_t limit = 0;
  std::string_view unit;  // "bytes", "streams"
};

using LimitUses = std::vector<LimitUse>;

// Whether there are limits for this user alone, so that one user's programs cannot keep out those
// of others. root, and the user of dssmd, could end dssmd anyway.
inline bool is_limited(uid_t user) noexcept { return user != 0 && user != ::geteuid(); }

// How much of a limit of all one user, other host or remote program may take (key max_share).
struct MaxShare {
  std::uint64_t percent = 100;
  std::uint64_t of(std::uint64_t limit) const noexcept {
    return limit / 100 * percent + limit % 100 * percent / 100;
  }
};

}  // namespace dssm::daemon
