// SPDX-License-Identifier: Apache-2.0
#include "client/dssmctl/stream_filter.hpp"

#include <fnmatch.h>

#include <algorithm>

namespace dssm::ctl {

bool StreamFilter::takes(const StreamId& id) const {
  if (!hosts_.empty() && std::find(hosts_.begin(), hosts_.end(), id.host) == hosts_.end()) {
    return false;
  }
  if (pattern_.empty()) return true;
  const auto fits = [&](const std::string& text) {
    return ::fnmatch(pattern_.c_str(), text.c_str(), 0) == 0;
  };
  // Without its part in the pattern no id and no host counts: `*2` is about names, and not about
  // all that pc2 has. A colon may also belong to a class of characters, [[:digit:]].
  const bool has_id = pattern_.find(':') != std::string::npos;
  const std::string with_id = id.name + ":" + std::to_string(id.id);
  if (pattern_.find('@') != std::string::npos) {
    return fits(id.name + "@" + id.host) || (has_id && fits(with_id + "@" + id.host));
  }
  return fits(id.name) || (has_id && fits(with_id));
}

}  // namespace dssm::ctl
