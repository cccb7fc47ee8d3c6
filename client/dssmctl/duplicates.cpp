// SPDX-License-Identifier: Apache-2.0
#include "client/dssmctl/duplicates.hpp"

namespace dssm::ctl {

Duplicates::Duplicates(const std::vector<StreamInfo>& streams) {
  for (const StreamInfo& stream : streams) {
    owners_[{stream.id.name, stream.id.id}].push_back(stream.id.host);
  }
  std::erase_if(owners_, [](const auto& entry) { return entry.second.size() < 2; });
}

}  // namespace dssm::ctl
