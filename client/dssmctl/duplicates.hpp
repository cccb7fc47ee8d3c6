// SPDX-License-Identifier: Apache-2.0
//
// Streams of several hosts that have the same name and id: without the host in its name such a
// stream opens only on a host that owns one.
#pragma once

#include <cstdint>
#include <dssm/stream.hpp>
#include <map>
#include <string>
#include <utility>
#include <vector>

namespace dssm::ctl {

class Duplicates {
 public:
  using Key = std::pair<std::string, std::int32_t>;  // name and id

  // `streams`: all that there are, of all hosts.
  explicit Duplicates(const std::vector<StreamInfo>& streams);

  bool has(const StreamId& id) const { return owners_.contains({id.name, id.id}); }

  // For each of them the hosts, two or more, in the order of `streams`.
  const std::map<Key, std::vector<std::string>>& owners() const { return owners_; }

 private:
  std::map<Key, std::vector<std::string>> owners_;
};

}  // namespace dssm::ctl
