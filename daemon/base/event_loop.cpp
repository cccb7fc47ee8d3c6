// SPDX-License-Identifier: Apache-2.0
#include "daemon/base/event_loop.hpp"

#include <event2/event.h>
#include <sys/timerfd.h>

#include <algorithm>
#include <utility>

#include "core/base/check.hpp"
#include "core/base/try.hpp"

namespace dssm::daemon {
namespace {

[[gnu::hot]] void on_event(evutil_socket_t, short, void* callback) noexcept {
  (*static_cast<EventSource::Callback*>(callback))();
}

constexpr timeval kNoDelay{};

// Without a lock, because there is one thread; without reading the clock in each turn, because
// libevent keeps none of our times (TimerQueue does).
event_base* new_base() noexcept {
  event_config* const config = event_config_new();
  if (!config) return nullptr;
  event_config_set_flag(config, EVENT_BASE_FLAG_NOLOCK | EVENT_BASE_FLAG_NO_CACHE_TIME);
  event_base* const base = event_base_new_with_config(config);
  event_config_free(config);
  return base;
}

}  // namespace

// --- timers

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

// --- the loop

Result<EventLoop> EventLoop::open(TimerQueue::Time time) {
  std::unique_ptr<TimerQueue> timers = DSSM_TRY(TimerQueue::open(time), "create the event loop");
  EventLoop loop(std::move(timers));
  if (!loop.base_) return os_error("create the event loop");
  loop.watch_timers();
  return loop;
}

EventLoop::EventLoop(std::unique_ptr<TimerQueue> timers)
    : base_(new_base()), timers_(std::move(timers)) {}

// Due timers run in the next turn, when what has arrived is handed out: after a stall, no
// timeout for missing bytes may expire while such bytes wait to be read.
void EventLoop::watch_timers() {
  run_timers_.reset(event_new(
      base(), -1, 0,
      [](evutil_socket_t, short, void* timers) noexcept {
        static_cast<TimerQueue*>(timers)->run_due();
      },
      timers_.get()));
  DSSM_CHECK(run_timers_);
  timer_is_due_.reset(event_new(
      base(), timers_->fd(), EV_READ | EV_ET | EV_PERSIST,
      [](evutil_socket_t, short, void* run_timers) noexcept {
        DSSM_CHECK(event_add(static_cast<event*>(run_timers), &kNoDelay) == 0);
      },
      run_timers_.get()));
  DSSM_CHECK(timer_is_due_ && event_add(timer_is_due_.get(), nullptr) == 0);
}

Result<void> EventLoop::run() {
  if (event_base_loop(base_.get(), EVLOOP_NO_EXIT_ON_EMPTY) < 0) {
    return os_error("run the event loop");
  }
  return {};
}

void EventLoop::stop() noexcept { event_base_loopbreak(base_.get()); }

void EventLoop::Free::operator()(event_base* base) const noexcept { event_base_free(base); }
void FreeEvent::operator()(event* source) const noexcept { event_free(source); }

EventSource::EventSource(const EventLoop& loop, int fd, short what, Callback callback)
    : callback_(std::make_unique<Callback>(std::move(callback))),
      event_(event_new(loop.base(), fd, what, on_event, callback_.get())) {
  DSSM_CHECK(event_);  // fails only without memory for a few dozen bytes
}

EventSource EventSource::readable(const EventLoop& loop, int fd, Callback callback) {
  return {loop, fd, EV_READ | EV_PERSIST, std::move(callback)};
}

EventSource EventSource::writable(const EventLoop& loop, int fd, Callback callback) {
  return {loop, fd, EV_WRITE | EV_PERSIST, std::move(callback)};
}

EventSource EventSource::edge(const EventLoop& loop, int fd, Callback callback) {
  return {loop, fd, EV_READ | EV_ET | EV_PERSIST, std::move(callback)};
}

EventSource EventSource::signal(const EventLoop& loop, int number, Callback callback) {
  return {loop, number, EV_SIGNAL | EV_PERSIST, std::move(callback)};
}

EventSource EventSource::timer(const EventLoop& loop, Callback callback) {
  EventSource timer(loop, -1, 0, std::move(callback));
  timer.timer_ = std::make_unique<TimerQueue::Timer>(loop.timers(), *timer.callback_);
  return timer;
}

void EventSource::enable() noexcept { DSSM_CHECK(event_add(event_.get(), nullptr) == 0); }

void EventSource::enable_in(Duration delay) noexcept {
  if (delay > Duration::zero()) {
    event_del(event_.get());
    return timer_->start_in(delay);
  }
  timer_->stop();
  // libevent would put one that is due at the end again: enabled in each turn, it would never run.
  if (event_pending(event_.get(), EV_TIMEOUT, nullptr)) return;
  DSSM_CHECK(event_add(event_.get(), &kNoDelay) == 0);
}

void EventSource::disable() noexcept {
  if (event_) event_del(event_.get());
  if (timer_) timer_->stop();
}

}  // namespace dssm::daemon
