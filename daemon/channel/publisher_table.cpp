// SPDX-License-Identifier: Apache-2.0
#include "daemon/channel/publisher_table.hpp"

#include <algorithm>

namespace dssm::daemon {

PublisherTable::Entry& PublisherTable::use(std::uint64_t publisher) {
  const auto found =
      std::find_if(entries_.begin(), entries_.end(),
                   [publisher](const Entry& entry) { return entry.publisher == publisher; });
  if (found != entries_.end()) {
    entries_.splice(entries_.begin(), entries_, found);
  } else {
    if (entries_.size() == kMaxPublishers) entries_.pop_back();
    entries_.push_front({publisher, -1, kNoTid});
  }
  return entries_.front();
}

}  // namespace dssm::daemon
