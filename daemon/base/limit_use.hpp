// SPDX-License-Identifier: Apache-2.0
//
// How much of a limit is used, for people: `dssmctl info` shows it. Each part of dssmd adds its own
// limits to a list; docs/limits.md lists all limits.
#pragma once

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

}  // namespace dssm::daemon
