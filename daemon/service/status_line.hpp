// SPDX-License-Identifier: Apache-2.0
//
// Keeps the line that `systemctl status` shows current, at most once in kPause and only when it
// changed. Costs nothing where nobody asks for it.
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

  // The line as it is now, which the caller tells the manager.
  std::string now();

  // Something changed that is in the line.
  void touch();

 private:
  void update();

  ServiceManager& manager_;
  std::function<std::string()> text_;
  std::string told_;
  bool due_ = false;
  EventSource timer_;
};

}  // namespace dssm::daemon
