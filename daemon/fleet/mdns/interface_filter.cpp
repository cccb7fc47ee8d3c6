// SPDX-License-Identifier: Apache-2.0
#include "daemon/fleet/mdns/interface_filter.hpp"

#include <fnmatch.h>
#include <net/if.h>

#include <algorithm>

#include "core/base/text.hpp"
#include "daemon/base/log.hpp"

namespace dssm::daemon {
namespace {

bool matches_any(const std::vector<std::string>& patterns, const std::string& name) {
  return std::any_of(patterns.begin(), patterns.end(), [&](const std::string& pattern) {
    return ::fnmatch(pattern.c_str(), name.c_str(), 0) == 0;
  });
}

}  // namespace

bool InterfaceFilter::admits(const std::string& name) const {
  return (use_.empty() || matches_any(use_, name)) && !matches_any(avoid_, name);
}

std::string InterfaceFilter::selection() const {
  std::string text;
  for (const std::string& pattern : use_) text += (text.empty() ? "" : ", ") + in_quotes(pattern);
  return text;
}

std::map<int, std::string> InterfaceFilter::existing() const {
  std::map<int, std::string> found;
  struct if_nameindex* const all = ::if_nameindex();
  if (!all) return found;
  for (const struct if_nameindex* one = all; one->if_index != 0; ++one) {
    if (admits(one->if_name)) found.emplace(static_cast<int>(one->if_index), one->if_name);
  }
  ::if_freenameindex(all);
  return found;
}

std::string interface_name(int index) {
  char name[IF_NAMESIZE] = "";
  if (index <= 0 || !::if_indextoname(static_cast<unsigned>(index), name)) return {};
  return name;
}

}  // namespace dssm::daemon
