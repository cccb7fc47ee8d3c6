// SPDX-License-Identifier: Apache-2.0
//
// What libavahi-client needs: an event loop (avahi-common/watch.h), which is ours.
#pragma once

#include <avahi-common/watch.h>

#include <dssm/time.hpp>
#include <memory>
#include <vector>

#include "daemon/base/event_loop.hpp"

namespace dssm::daemon {

// Whether that error of a call concerns the connection to Avahi and not what was asked.
bool is_avahi_connection_error(int error) noexcept;

// How long to wait for a time that Avahi gives by the wall clock. Once converted, a step of the
// wall clock does not matter any more; one that falls in between costs a minute at most, twice as
// long as anything libavahi-client waits for (D-Bus's timeout, 25 s).
//   returns  0 to one minute
Duration delay_until(const timeval& when, Time now) noexcept;

// Watches and timeouts may be freed inside any callback, their own included. All of it belongs to
// the loop's thread; whatever was made by it is freed before it.
class LoopAvahiPoll {
 public:
  explicit LoopAvahiPoll(const EventLoop& loop);
  LoopAvahiPoll(const LoopAvahiPoll&) = delete;
  LoopAvahiPoll& operator=(const LoopAvahiPoll&) = delete;
  ~LoopAvahiPoll();

  const AvahiPoll* api() const noexcept { return &api_; }
  const EventLoop& loop() const noexcept { return loop_; }

  // Destroy later what may be in the middle of its callback.
  void defer_delete(AvahiWatch* watch);
  void defer_delete(AvahiTimeout* timeout);

 private:
  const EventLoop& loop_;
  AvahiPoll api_{};
  std::vector<std::unique_ptr<AvahiWatch>> freed_watches_;
  std::vector<std::unique_ptr<AvahiTimeout>> freed_timeouts_;
  EventSource sweeper_;
};

}  // namespace dssm::daemon
