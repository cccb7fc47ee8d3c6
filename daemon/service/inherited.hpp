// SPDX-License-Identifier: Apache-2.0
//
// What the service manager handed over, sorted by what it is. Names do not count but to tell
// sockets that dssmd put into the descriptor store itself from those of a socket unit.
#pragma once

#include <optional>
#include <string>
#include <vector>

#include "daemon/service/service_manager.hpp"

namespace dssm::daemon {

struct Inherited {
  // Listening sockets; non-blocking by now.
  std::vector<NamedDescriptor> local;    // AF_UNIX, streams
  std::vector<NamedDescriptor> network;  // TCP
  std::vector<NamedDescriptor> others;   // what DescriptorStore kept, and anything else

  static Inherited sort(std::vector<NamedDescriptor> handed_over);

  // Takes the socket that listens at `path` out of `local`; none: none does.
  UniqueFd take_local(const std::string& path);
};

}  // namespace dssm::daemon
