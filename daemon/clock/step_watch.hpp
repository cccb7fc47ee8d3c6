// SPDX-License-Identifier: Apache-2.0
//
// Notifies at once that the wall clock was set (timerfd_create(2), TFD_TIMER_CANCEL_ON_SET), or
// that the PC woke from sleep, but not by how much. Slewing is not reported.
#pragma once

#include <dssm/result.hpp>
#include <functional>
#include <memory>

#include "core/base/unique_fd.hpp"
#include "daemon/base/event_loop.hpp"

namespace dssm::daemon {

class StepWatch {
 public:
  // Calls on_set from the loop, which outlives it; several sets may lead to one call.
  static Result<std::unique_ptr<StepWatch>> open(const EventLoop& loop,
                                                 std::function<void()> on_set);
  StepWatch(const StepWatch&) = delete;
  StepWatch& operator=(const StepWatch&) = delete;

 private:
  StepWatch(const EventLoop& loop, UniqueFd timer, std::function<void()> on_set);
  void on_readable();

  UniqueFd timer_;
  std::function<void()> on_set_;
  EventSource readable_;
};

}  // namespace dssm::daemon
