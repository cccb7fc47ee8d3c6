// SPDX-License-Identifier: Apache-2.0
#include "client/src/readiness.hpp"

#include <sys/epoll.h>
#include <sys/timerfd.h>

#include <algorithm>

#include "core/base/timespec.hpp"

namespace dssm::detail {

Result<Readiness> Readiness::make() {
  Readiness made;
  made.epoll_ = UniqueFd(::epoll_create1(EPOLL_CLOEXEC));
  made.timer_ = UniqueFd(::timerfd_create(CLOCK_MONOTONIC, TFD_CLOEXEC | TFD_NONBLOCK));
  epoll_event event{};
  event.events = EPOLLIN;
  event.data.fd = made.timer_.get();
  if (!made.epoll_ || !made.timer_ ||
      ::epoll_ctl(made.epoll_.get(), EPOLL_CTL_ADD, made.timer_.get(), &event)) {
    return os_error("make a descriptor to poll");
  }
  return made;
}

void Readiness::follow(int socket, short events, MonoTime at) noexcept {
  // The socket may be another one with the number of the last: a closed one leaves the set by
  // itself.
  if (socket >= 0) {
    epoll_event event{};
    event.events = static_cast<std::uint32_t>(events);  // poll's bits and epoll's are the same
    event.data.fd = socket;
    if (::epoll_ctl(epoll_.get(), EPOLL_CTL_MOD, socket, &event)) {
      ::epoll_ctl(epoll_.get(), EPOLL_CTL_ADD, socket, &event);
    }
  }
  itimerspec timer{};  // all 0: off
  if (at != kNever) {
    timer.it_value = timespec_of(std::max(at, MonoTime(Duration(1))));
  }
  ::timerfd_settime(timer_.get(), TFD_TIMER_ABSTIME, &timer, nullptr);
}

}  // namespace dssm::detail
