// SPDX-License-Identifier: Apache-2.0
//
// libevent with owners. One loop, one thread; everything in dssmd happens in callbacks of it, and
// no callback waits for anything. Callbacks are called from C, so an exception that leaves one
// (out of memory) ends the process: rings do not need it to live on.
#pragma once

#include <cstdint>
#include <dssm/result.hpp>
#include <dssm/time.hpp>
#include <functional>
#include <map>
#include <memory>
#include <optional>

#include "core/base/time.hpp"
#include "core/base/unique_fd.hpp"

struct event_base;
struct event;

namespace dssm::daemon {

// The timers of one event loop, on one timerfd. libevent's own timers become a timeout of
// epoll_wait(): the kernel sets a timer up before each sleep and takes it down after it, although
// the first one due stays the same for thousands of samples. Here the kernel gets another
// time only when another timer is the first.
//
// The time of a queue is MonoClock's. In tests it can be simulated: then it does not advance
// between calls of run_next(), each of which sets it to the time of the first timer.
//
//   threads  one
class TimerQueue {
 public:
  class Timer;

  enum class Time : std::uint8_t { real, simulated };

  //   fails  os errors: no descriptor left
  static Result<std::unique_ptr<TimerQueue>> open(Time time = Time::real);

  MonoTime now() const noexcept { return simulated_ ? *simulated_ : MonoClock::now(); }
  MonoTime coarse_now() const noexcept { return simulated_ ? *simulated_ : dssm::coarse_now(); }
  // The time `delay` from now; kNever where that would overflow.
  MonoTime deadline_in(Duration delay) const noexcept;
  bool is_simulated() const noexcept { return simulated_.has_value(); }

  // Gets readable when a timer is due. To be watched edge-triggered, and never read.
  int fd() const noexcept { return fd_.get(); }
  // Then calls back those that are due, in the order of their times.
  void run_due();
  // Simulated time only: runs the first timer and those of the same time; false without a timer.
  bool run_next();

 private:
  using Waiting = std::multimap<MonoTime, Timer*>;  // of one time: in the order of their starts

  explicit TimerQueue(UniqueFd fd) noexcept : fd_(std::move(fd)) {}
  void arm() noexcept;

  UniqueFd fd_;
  std::optional<MonoTime> simulated_;
  Waiting waiting_;
  MonoTime armed_ = kNever;  // the time that the kernel has
  bool running_ = false;
};

// Calls back once at the time that it is started for, unless it is stopped or started again before.
// The callback may do both. The queue outlives it.
class TimerQueue::Timer {
 public:
  // callback outlives the timer.
  Timer(TimerQueue& queue, const std::function<void()>& callback);
  Timer(const Timer&) = delete;
  Timer& operator=(const Timer&) = delete;
  ~Timer();

  void start(MonoTime when) noexcept;
  void start_in(Duration delay) noexcept { start(queue_.deadline_in(delay)); }
  void stop() noexcept;

 private:
  friend class TimerQueue;

  TimerQueue& queue_;
  const std::function<void()>& callback_;
  Waiting::node_type node_;    // while it is idle: starting allocates nothing
  Waiting::iterator place_{};  // while it waits
};

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
