// SPDX-License-Identifier: Apache-2.0
//
// The descriptors that the service manager passed to dssmd, sorted by their kind. Names matter only
// to distinguish sockets that dssmd put into the descriptor store from those of a socket unit.
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
