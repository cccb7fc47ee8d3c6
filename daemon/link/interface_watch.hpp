// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <functional>

#include "core/base/unique_fd.hpp"
#include "daemon/base/event_loop.hpp"

namespace dssm::daemon {

// Calls back when network interfaces may have been added, removed, renamed, connected or
// disconnected (rtnetlink(7)).
class InterfaceWatch {
 public:
  // The loop outlives it.
  InterfaceWatch(const EventLoop& loop, std::function<void()> on_change);
  InterfaceWatch(const InterfaceWatch&) = delete;
  InterfaceWatch& operator=(const InterfaceWatch&) = delete;

 private:
  UniqueFd netlink_;
  EventSource source_;
};

}  // namespace dssm::daemon
