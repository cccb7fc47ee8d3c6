// SPDX-License-Identifier: Apache-2.0
//
// Bounds the time of the loop that clients get together, however many there are: samples and timers
// of others must not wait until each of a thousand connections had its turn.
#pragma once

#include <functional>
#include <map>
#include <string>
#include <utility>

#include "daemon/base/event_loop.hpp"

namespace dssm::daemon {

// The clients of one server. In each turn of the loop they work for kMaxTurn together, and as long
// as the last piece of work takes. Those that have to wait are called later: one account after
// another, for kMaxVisit each, and of an account the client that has used the least time in such
// calls. So a program that asks for little does not wait for hundreds that always have more to do.
// A client that waits with requests and one that waits for events take turns, too, as if they were
// of two accounts: an answer does not wait until hundreds of programs got their events.
//
//   threads  one
class TurnQueue {
 public:
  static constexpr Duration kMaxTurn = std::chrono::milliseconds(1);
  static constexpr Duration kMaxVisit = kMaxTurn / 2;

  enum class Reason { request, event };

  class Turn;
  using Waiting = std::multimap<Duration, Turn*>;  // of one account, by what they have used
  using Account = std::pair<std::string, Reason>;
  using AllWaiting = std::map<Account, Waiting>;

  // One client's place.
  class Turn {
   public:
    // queue: outlives this.
    //   account  whose turn it is, as Identity::account()
    //   take     called from the loop after wait(); must not destroy this
    Turn(TurnQueue& queue, std::string account, std::function<void()> take);
    Turn(const Turn&) = delete;
    Turn& operator=(const Turn&) = delete;
    ~Turn() { stop(); }

    // Whether the client may work now. If not, it waits.
    bool may_begin(Reason reason = Reason::request);
    // A client that waits for events may begin to wait with a request, not the other way round.
    void wait(Reason reason = Reason::request);
    bool is_waiting() const noexcept { return is_waiting_; }
    void stop() noexcept;  // it does not wait any more

   private:
    friend class TurnQueue;
    TurnQueue& queue_;
    const Account requests_, events_;
    const std::function<void()> take_;
    Reason reason_{};  // of its last wait
    bool is_waiting_ = false, is_called_ = false;
    Duration used_{};  // of the loop's time, when it was called; at least `least_`
    AllWaiting::iterator of_account_{};  // this and the next: while it waits
    Waiting::iterator place_{};
  };

  // Measures a piece of work from its construction to its end. One within another one counts once.
  class Work {
   public:
    explicit Work(TurnQueue& queue) : queue_(queue), before_(queue.used_) {}
    Work(const Work&) = delete;
    Work& operator=(const Work&) = delete;
    ~Work() { queue_.used_ = before_ + (MonoClock::now() - begin_); }

   private:
    TurnQueue& queue_;
    const Duration before_;
    const MonoTime begin_ = MonoClock::now();
  };

  explicit TurnQueue(const EventLoop& loop) : next_(EventSource::timer(loop, [this] { run(); })) {}

 private:
  void run();
  void call(Turn& turn);

  AllWaiting waiting_;  // none is empty
  // The greatest `used_` of a client that was called. A client that begins to wait gets at least
  // this: otherwise a new one, or one that was idle, would be called again and again until it has
  // used as much as the others.
  Duration least_{};
  Account last_;     // that was called
  Duration used_{};  // since run(), or of several turns of the loop in which nobody had to wait
  EventSource next_;
};

}  // namespace dssm::daemon
