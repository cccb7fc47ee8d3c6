// SPDX-License-Identifier: Apache-2.0
//
// Where programs look for dssmd and where ssm-coordinator starts one, so that both agree without
// any setting: $DSSM_SOCKET if set; else the PC's /run/dssm/dssmd.sock; else, for people without
// rights on /run, dssmd.sock in $XDG_RUNTIME_DIR/dssm, which only they can use.
#pragma once

#include <cstdlib>
#include <string>
#include <vector>

namespace dssm::ssm {

inline constexpr const char* kSystemFolder = "/run/dssm";
inline constexpr const char* kSocketName = "dssmd.sock";

// An environment variable's value, "" when it is not set.
inline std::string environment(const char* name) {
  const char* value = std::getenv(name);  // NOLINT(concurrency-mt-unsafe): SSM programs set nothing
  return value ? value : "";
}

// The user's own folder; "" when there is none.
inline std::string user_folder() {
  const std::string base = environment("XDG_RUNTIME_DIR");
  return base.empty() ? base : base + "/dssm";
}

// In the order to try.
inline std::vector<std::string> socket_paths() {
  if (std::string set = environment("DSSM_SOCKET"); !set.empty()) return {std::move(set)};
  std::vector<std::string> paths{std::string(kSystemFolder) + "/" + kSocketName};
  if (const std::string own = user_folder(); !own.empty()) paths.push_back(own + "/" + kSocketName);
  return paths;
}

}  // namespace dssm::ssm
