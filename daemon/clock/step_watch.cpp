// SPDX-License-Identifier: Apache-2.0
#include "daemon/clock/step_watch.hpp"

#include <sys/timerfd.h>
#include <unistd.h>

#include <cerrno>
#include <cstdint>
#include <limits>
#include <utility>

namespace dssm::daemon {
namespace {

// For a time that never comes. It expires at once when the clock was set since it was armed last.
bool arm(int timer) noexcept {
  itimerspec never{};
  never.it_value.tv_sec = std::numeric_limits<time_t>::max();
  return ::timerfd_settime(timer, TFD_TIMER_ABSTIME | TFD_TIMER_CANCEL_ON_SET, &never, nullptr) ==
             0 ||
         errno == ECANCELED;  // armed, and the clock is being set
}

}  // namespace

Result<std::unique_ptr<StepWatch>> StepWatch::open(const EventLoop& loop,
                                                   std::function<void()> on_set) {
  UniqueFd timer(::timerfd_create(CLOCK_REALTIME, TFD_NONBLOCK | TFD_CLOEXEC));
  if (!timer || !arm(timer.get())) return os_error("watch the wall clock for steps");
  return std::unique_ptr<StepWatch>(new StepWatch(loop, std::move(timer), std::move(on_set)));
}

StepWatch::StepWatch(const EventLoop& loop, UniqueFd timer, std::function<void()> on_set)
    : timer_(std::move(timer)),
      on_set_(std::move(on_set)),
      readable_(EventSource::readable(loop, timer_.get(), [this] { on_readable(); })) {
  readable_.enable();
}

void StepWatch::on_readable() {
  std::uint64_t expired = 0;
  // Fails with ECANCELED when the clock was set: that is the event.
  [[maybe_unused]] const ssize_t got = ::read(timer_.get(), &expired, sizeof expired);
  // Armed before the clock is read, so that no step is missed in between.
  arm(timer_.get());
  on_set_();
}

}  // namespace dssm::daemon
