// SPDX-License-Identifier: Apache-2.0
//
// Timers behind one timerfd, alone and in an event loop: their order, starting and stopping in
// callbacks, which system calls they cost, and simulated time.
#include <gtest/gtest.h>
#include <poll.h>
#include <sys/eventfd.h>
#include <unistd.h>

#include <memory>
#include <optional>
#include <random>
#include <string>
#include <vector>

#include "daemon/base/event_loop.hpp"

namespace dssm::daemon {
namespace {

using namespace std::chrono_literals;

class TimerQueueTest : public testing::Test {
 protected:
  struct One {
    One(TimerQueue& queue, std::function<void()> callback)
        : then(std::move(callback)), timer(queue, then) {}
    std::function<void()> then;
    TimerQueue::Timer timer;
  };
  // A timer that notes its name.
  std::unique_ptr<One> noting(char name) {
    return std::make_unique<One>(*queue, [this, name] { fired += name; });
  }
  bool is_readable(int timeout_ms) const {
    pollfd fd{queue->fd(), POLLIN, 0};
    return ::poll(&fd, 1, timeout_ms) == 1;
  }
  // As the loop does, until `names` have fired.
  void run(std::size_t names) {
    while (fired.size() < names) {
      ASSERT_TRUE(is_readable(20'000));
      queue->run_due();
    }
  }

  std::unique_ptr<TimerQueue> queue = TimerQueue::open().value();
  std::string fired;
};

TEST_F(TimerQueueTest, SimulatedTimeStandsStillBetweenTimers) {
  queue = TimerQueue::open(TimerQueue::Time::simulated).value();
  const MonoTime begin = queue->now();
  EXPECT_FALSE(queue->run_next());
  const auto hour = noting('h'), second = noting('s'), same = noting('e');
  hour->timer.start_in(1h);
  second->timer.start_in(1s);
  same->timer.start_in(1s);
  EXPECT_TRUE(queue->run_next());
  EXPECT_EQ(fired, "se");
  EXPECT_EQ(queue->now(), begin + 1s);
  EXPECT_EQ(queue->coarse_now(), queue->now());
  EXPECT_TRUE(queue->run_next());
  EXPECT_EQ(queue->now(), begin + 1h);
  EXPECT_EQ(queue->deadline_in(Duration::max()), kNever);
  EXPECT_FALSE(is_readable(0)) << "the kernel has no part in it";
}

TEST_F(TimerQueueTest, FiresInTheOrderOfTimesNotBefore) {
  const auto a = noting('a'), b = noting('b'), c = noting('c'), d = noting('d');
  const MonoTime begin = MonoClock::now();
  a->timer.start(begin + 30ms);
  b->timer.start(begin + 10ms);
  c->timer.start(begin + 20ms);
  d->timer.start(begin + 10ms);
  run(2);
  EXPECT_GE(MonoClock::now(), begin + 10ms);
  run(4);
  EXPECT_GE(MonoClock::now(), begin + 30ms);
  EXPECT_EQ(fired, "bdca") << "of one time: as they were started";
  EXPECT_FALSE(is_readable(0)) << "each once";
}

// What was moved or stopped wakes nobody up.
TEST_F(TimerQueueTest, SetsTheKernelsTimerWhenTheFirstOneChanges) {
  const auto a = noting('a'), b = noting('b');
  a->timer.start(deadline_in(1ms));
  a->timer.start(deadline_in(10min));
  EXPECT_FALSE(is_readable(20));
  a->timer.stop();
  a->timer.start(kNever);
  b->timer.start(deadline_in(1ms));
  b->timer.stop();
  EXPECT_FALSE(is_readable(20));
  b->timer.start(deadline_in(1ms));
  EXPECT_TRUE(is_readable(20'000));
  b->timer.start(deadline_in(10min));
  EXPECT_FALSE(is_readable(0)) << "although it was due already";
  queue->run_due();
  EXPECT_EQ(fired, "");
  b->timer.start(MonoTime(1ns));
  run(1);
  EXPECT_EQ(fired, "b") << "of the past: at once";
}

TEST_F(TimerQueueTest, LetsCallbacksStartStopAndDestroyTimers) {
  auto victim = noting('v');
  const auto stopped = noting('s');
  std::optional<One> again;
  int rounds = 0;
  again.emplace(*queue, [&] {
    fired += 'a';
    victim.reset();
    stopped->timer.stop();
    if (++rounds < 3) again->timer.start(deadline_in(1ms));
  });
  const MonoTime due = deadline_in(1ms);
  again->timer.start(due);
  victim->timer.start(due);
  stopped->timer.start(due);
  run(3);
  EXPECT_EQ(fired, "aaa");
  EXPECT_FALSE(is_readable(20));
}

TEST_F(TimerQueueTest, DoesNotStarveOthersByTimersThatAreAlwaysDue) {
  std::optional<One> eager;
  eager.emplace(*queue, [&] {
    fired += 'e';
    eager->timer.start(MonoClock::now() + 1ns);
  });
  eager->timer.start(MonoTime(1ns));
  ASSERT_TRUE(is_readable(20'000));
  queue->run_due();
  EXPECT_EQ(fired, "e") << "once in each turn of the loop";
  EXPECT_TRUE(is_readable(20'000));
}

TEST_F(TimerQueueTest, KeepsThousandsInOrder) {
  const auto seed = std::random_device()();
  SCOPED_TRACE("seed " + std::to_string(seed));
  std::mt19937 random(seed);
  std::vector<MonoTime> times;
  std::vector<std::unique_ptr<One>> timers;
  const MonoTime begin = MonoClock::now();
  std::vector<MonoTime> when(3000);
  for (MonoTime& time : when) {
    timers.push_back(std::make_unique<One>(*queue, [&times, &time] { times.push_back(time); }));
    for (int moved = 0; moved < 3; ++moved) {
      time = begin + std::chrono::microseconds(random() % 50'000);
      timers.back()->timer.start(time);
    }
  }
  for (std::size_t i = 0; i < timers.size(); i += 3) timers[i]->timer.stop();
  while (times.size() < 2000) {
    ASSERT_TRUE(is_readable(20'000));
    queue->run_due();
  }
  EXPECT_TRUE(std::is_sorted(times.begin(), times.end()));
  EXPECT_FALSE(is_readable(0));
}

// After a stall both are due: whoever judges a silence has to hear first what has been said.
TEST(EventLoopTimers, RunAfterWhatHasArrived) {
  EventLoop loop = EventLoop::open().value();
  const UniqueFd arrival(::eventfd(0, EFD_CLOEXEC));
  std::string order;
  EventSource timer = EventSource::timer(loop, [&] { order += 't', loop.stop(); });
  EventSource arrived = EventSource::edge(loop, arrival.get(), [&] { order += 'a'; });
  arrived.enable();
  timer.enable_in(1ms);
  pollfd due{loop.timers().fd(), POLLIN, 0};
  ASSERT_EQ(::poll(&due, 1, 20'000), 1);
  const std::uint64_t one = 1;
  ASSERT_EQ(::write(arrival.get(), &one, sizeof one), ssize_t{sizeof one});
  ASSERT_TRUE(loop.run());
  EXPECT_EQ(order, "at");
}

TEST(EventLoopTimers, RunThoughSomethingWantsThemInEachTurn) {
  EventLoop loop = EventLoop::open().value();
  const UniqueFd always_readable(::eventfd(1, EFD_CLOEXEC));
  int turns = 0;
  bool has_run = false;
  EventSource soon = EventSource::timer(loop, [&] { has_run = true, loop.stop(); });
  EventSource busy = EventSource::readable(loop, always_readable.get(), [&] {
    soon.enable_in(Duration::zero());
    if (++turns == 100) loop.stop();
  });
  busy.enable();
  ASSERT_TRUE(loop.run());
  EXPECT_TRUE(has_run);
}

// With and without a delay, in libevent's loop.
TEST(EventLoopTimers, ComeInTheNextTurnOrLater) {
  EventLoop loop = EventLoop::open().value();
  std::string order;
  int turns = 0;
  std::optional<EventSource> next;
  next = EventSource::timer(loop, [&] {
    order += 'n';
    if (++turns == 100) return loop.stop();
    next->enable_in(Duration::zero());
  });
  EventSource later = EventSource::timer(loop, [&] {
    order += 'l';
    next->enable_in(10min);             // instead of the next turn
    next->enable_in(Duration::zero());  // and back
    turns = 99;
  });
  later.enable_in(1ms);
  ASSERT_TRUE(loop.run());
  EXPECT_EQ(order, "ln");
  order.clear();
  turns = 0;
  next->enable_in(Duration::zero());
  ASSERT_TRUE(loop.run());
  EXPECT_EQ(order, std::string(100, 'n'));
  order.clear();
  EventSource stop = EventSource::timer(loop, [&] { loop.stop(); });
  later.enable_in(1ms);
  later.disable();
  next->enable_in(Duration::zero());
  next->disable();
  stop.enable_in(20ms);
  ASSERT_TRUE(loop.run());
  EXPECT_EQ(order, "") << "they were disabled";
}

}  // namespace
}  // namespace dssm::daemon
