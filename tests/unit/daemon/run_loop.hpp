// SPDX-License-Identifier: Apache-2.0
//
// Runs an event loop in unit tests, in real or in simulated time.
//
// Simulated time (EventLoop::open(TimerQueue::Time::simulated)) stands still while anything
// happens, and moves to the next timer when nothing has happened for kQuietTime of real time.
// Sockets are real: between two sockets of one process (with TCP_NODELAY) the kernel delivers
// within the system call that sends. So a test
// that waits for seconds takes milliseconds, and a stall of the machine does not let deadlines
// pass.
#pragma once

#include <event2/event.h>

#include <functional>
#include <memory>

#include "daemon/base/event_loop.hpp"

namespace dssm::daemon {

// Runs the callbacks of one turn of the loop; in simulated time, when nothing happens, of the next
// timer.
inline void run_once(const EventLoop& loop) {
  if (!loop.timers().is_simulated()) {
    event_base_loop(loop.base(), EVLOOP_ONCE);
    return;
  }
  constexpr timeval kQuietTime{0, 2000};
  bool quiet = false;
  const std::unique_ptr<event, FreeEvent> timeout(event_new(
      loop.base(), -1, 0,
      [](evutil_socket_t, short, void* is_quiet) { *static_cast<bool*>(is_quiet) = true; },
      &quiet));
  event_add(timeout.get(), &kQuietTime);
  event_base_get_max_events(loop.base(), EVENT_BASE_COUNT_ACTIVE, 1);
  event_base_loop(loop.base(), EVLOOP_ONCE);
  // After a stall, others may have happened together with the timeout.
  const bool alone = event_base_get_max_events(loop.base(), EVENT_BASE_COUNT_ACTIVE, 0) == 1;
  if (quiet && alone) loop.timers().run_next();
}

// Runs the callbacks that are due, `turns` times; simulated time stands still.
inline void run_turns(const EventLoop& loop, int turns = 1) {
  for (int i = 0; i < turns; ++i) event_base_loop(loop.base(), EVLOOP_ONCE | EVLOOP_NONBLOCK);
}

// Runs callbacks until `done`; meson's time limit is the watchdog.
inline void run_until(const EventLoop& loop, const std::function<bool()>& done) {
  while (!done()) run_once(loop);
}

}  // namespace dssm::daemon
