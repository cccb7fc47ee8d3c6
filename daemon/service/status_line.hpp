// SPDX-License-Identifier: Apache-2.0
//
// Updates the line that `systemctl status` shows, at most once in kPause and only when it changed.
// Does nothing without a service manager.
#pragma once

#include <dssm/time.hpp>
#include <functional>
#include <string>

#include "daemon/base/event_loop.hpp"
#include "daemon/service/service_manager.hpp"

namespace dssm::daemon {

class StatusLine {
 public:
  static constexpr Duration kPause = std::chrono::seconds(1);

  // text: makes the line, from the loop. manager: outlives it.
  StatusLine(const EventLoop& loop, ServiceManager& manager, std::function<std::string()> text);
  StatusLine(const StatusLine&) = delete;
  StatusLine& operator=(const StatusLine&) = delete;

  // The line as it is now, for the caller to send to the manager.
  std::string now();

  // Something changed that is in the line.
  void touch();

 private:
  void update();

  ServiceManager& manager_;
  std::function<std::string()> text_;
  std::string sent_;
  bool due_ = false;
  EventSource timer_;
};

}  // namespace dssm::daemon
