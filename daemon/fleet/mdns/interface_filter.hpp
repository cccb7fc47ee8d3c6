// SPDX-License-Identifier: Apache-2.0
//
// Which network interfaces to use, by the patterns of the configuration.
#pragma once

#include <map>
#include <string>
#include <vector>

namespace dssm::daemon {

class InterfaceFilter {
 public:
  // Names or patterns (fnmatch(3)): those in `use`, all when that is empty, without those in
  // `avoid`.
  InterfaceFilter(std::vector<std::string> use, std::vector<std::string> avoid)
      : use_(std::move(use)), avoid_(std::move(avoid)) {}

  bool admits(const std::string& name) const;
  // Whether only some are named, so that one has to know which there are.
  bool selects() const noexcept { return !use_.empty(); }
  std::string selection() const;  // "'eth*', 'wlan0'"

  // Those that there are now, by index.
  std::map<int, std::string> existing() const;

 private:
  std::vector<std::string> use_, avoid_;
};

// The name of the interface with that index; empty: it is not there any more.
std::string interface_name(int index);

}  // namespace dssm::daemon
