// SPDX-License-Identifier: Apache-2.0
#include "daemon/base/timer_queue.hpp"

#include <sys/timerfd.h>

#include <algorithm>
#include <utility>

#include "core/base/check.hpp"

namespace dssm::daemon {

Result<std::unique_ptr<TimerQueue>> TimerQueue::open(Time time) {
  UniqueFd fd(::timerfd_create(CLOCK_MONOTONIC, TFD_NONBLOCK | TFD_CLOEXEC));
  if (!fd) return os_error("create a timer");
  std::unique_ptr<TimerQueue> queue(new TimerQueue(std::move(fd)));
  if (time == Time::simulated) queue->simulated_ = MonoClock::now();
  return queue;
}

MonoTime TimerQueue::deadline_in(Duration delay) const noexcept {
  const MonoTime from = now();
  return delay > kNever - from ? kNever : from + delay;
}

// Setting the timerfd also makes it unreadable, so that it need not be read.
void TimerQueue::arm() noexcept {
  const MonoTime first = waiting_.empty() ? kNever : waiting_.begin()->first;
  if (running_ || simulated_ || first == armed_) return;
  armed_ = first;
  itimerspec when{};
  if (first != kNever) {
    const auto since_boot = first.time_since_epoch();
    const auto seconds = std::chrono::floor<std::chrono::seconds>(since_boot);
    when.it_value = {static_cast<time_t>(seconds.count()),
                     static_cast<long>((since_boot - seconds).count())};
  }
  DSSM_CHECK(::timerfd_settime(fd_.get(), TFD_TIMER_ABSTIME, &when, nullptr) == 0);
}

void TimerQueue::run_due() {
  running_ = true;
  // One that a callback starts is later than this, so the loop gets to its other events.
  const MonoTime until = now();
  while (!waiting_.empty() && waiting_.begin()->first <= until) {
    Timer& due = *waiting_.begin()->second;
    due.stop();
    due.callback_();
  }
  running_ = false;
  armed_ = MonoTime();  // it has expired
  arm();
}

bool TimerQueue::run_next() {
  DSSM_CHECK(simulated_);
  if (waiting_.empty()) return false;
  simulated_ = std::max(*simulated_, waiting_.begin()->first);
  run_due();
  return true;
}

TimerQueue::Timer::Timer(TimerQueue& queue, const std::function<void()>& callback)
    : queue_(queue), callback_(callback) {
  Waiting one;
  node_ = one.extract(one.emplace(MonoTime(), this));
}

TimerQueue::Timer::~Timer() { stop(); }

void TimerQueue::Timer::start(MonoTime when) noexcept {
  if (node_.empty()) node_ = queue_.waiting_.extract(place_);
  node_.key() = when;
  place_ = queue_.waiting_.insert(std::move(node_));
  queue_.arm();
}

void TimerQueue::Timer::stop() noexcept {
  if (!node_.empty()) return;
  node_ = queue_.waiting_.extract(place_);
  queue_.arm();
}

}  // namespace dssm::daemon
