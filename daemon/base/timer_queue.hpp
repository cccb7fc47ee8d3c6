// SPDX-License-Identifier: Apache-2.0
//
// The timers of one event loop, on one timerfd. libevent's own timers become a timeout of
// epoll_wait(): the kernel sets a timer up before each sleep and takes it down after it, although
// the first one due stays the same for thousands of samples. Here the kernel gets another
// time only when another timer is the first.
//
// The time of a queue is MonoClock's. In tests it can be simulated: then it does not advance
// between calls of run_next(), each of which sets it to the time of the first timer.
//
//   threads  one
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

namespace dssm::daemon {

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

}  // namespace dssm::daemon
