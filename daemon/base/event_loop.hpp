// SPDX-License-Identifier: Apache-2.0
//
// libevent with owners. One loop, one thread; everything in dssmd happens in callbacks of it, and
// no callback waits for anything. Callbacks are called from C, so an exception that leaves one
// (out of memory) ends the process: rings do not need it to live on.
#pragma once

#include <dssm/result.hpp>
#include <dssm/time.hpp>
#include <functional>
#include <memory>

#include "daemon/base/timer_queue.hpp"

struct event_base;
struct event;

namespace dssm::daemon {

struct FreeEvent {
  void operator()(event* source) const noexcept;
};

class EventLoop {
 public:
  //   time  simulated: for tests, see TimerQueue
  static Result<EventLoop> open(TimerQueue::Time time = TimerQueue::Time::real);

  // Runs callbacks until stop().
  Result<void> run();
  // Lets the running callback finish, then ends run().
  void stop() noexcept;

  // The time that its timers go by. Code that sets timers reads the time here, not from MonoClock.
  MonoTime now() const noexcept { return timers_->now(); }
  // The same at a fifth of the price, some milliseconds late (dssm::coarse_now()).
  MonoTime coarse_now() const noexcept { return timers_->coarse_now(); }
  MonoTime deadline_in(Duration delay) const noexcept { return timers_->deadline_in(delay); }

  event_base* base() const noexcept { return base_.get(); }
  TimerQueue& timers() const noexcept { return *timers_; }

 private:
  struct Free {
    void operator()(event_base* base) const noexcept;
  };
  explicit EventLoop(std::unique_ptr<TimerQueue> timers);
  void watch_timers();
  std::unique_ptr<event_base, Free> base_;
  std::unique_ptr<TimerQueue> timers_;
  std::unique_ptr<event, FreeEvent> run_timers_, timer_is_due_;
};

// Calls back when something happens; idle until enable(). The callback may disable its own source
// but not destroy it. The loop outlives it.
class EventSource {
 public:
  using Callback = std::function<void()>;

  EventSource() = default;
  static EventSource readable(const EventLoop& loop, int fd, Callback callback);
  static EventSource writable(const EventLoop& loop, int fd, Callback callback);
  // Edge-triggered: calls back once for each time that `fd` becomes readable again (each write to
  // an eventfd), whether or not it is read. `fd` must have no other source in this loop.
  static EventSource edge(const EventLoop& loop, int fd, Callback callback);
  static EventSource signal(const EventLoop& loop, int number, Callback callback);
  // Without a delay it calls back in the loop's next turn, when other events had theirs; with one,
  // when it is over and all that had arrived by then is handed out.
  static EventSource timer(const EventLoop& loop, Callback callback);

  void enable() noexcept;
  void enable_in(Duration delay) noexcept;  // timers: once, after `delay`
  void disable() noexcept;

 private:
  EventSource(const EventLoop& loop, int fd, short what, Callback callback);
  std::unique_ptr<Callback> callback_;       // on the heap: libevent keeps its address
  std::unique_ptr<event, FreeEvent> event_;  // of a timer: for the next turn
  std::unique_ptr<TimerQueue::Timer> timer_;
};

}  // namespace dssm::daemon
