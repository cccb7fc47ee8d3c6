// SPDX-License-Identifier: Apache-2.0
#include "daemon/base/turn_queue.hpp"

#include <gtest/gtest.h>

#include <list>
#include <string>

#include "tests/unit/daemon/run_loop.hpp"

namespace dssm::daemon {
namespace {

class TurnQueueTest : public testing::Test {
 protected:
  // A client that always has more to do, each time for longer than all may work in one turn.
  struct Client {
    Client(TurnQueueTest& test, const std::string& account, std::string name)
        : turn(test.queue, account, [&test, this, name] {
            test.called += name;
            test.work();
            turn.wait();
          }) {}
    TurnQueue::Turn turn;
  };

  void work() {
    const TurnQueue::Work work(queue);
    for (const MonoTime begin = MonoClock::now(); MonoClock::now() - begin < TurnQueue::kMaxTurn;) {
    }
  }

  EventLoop loop = EventLoop::open(TimerQueue::Time::simulated).value();
  TurnQueue queue{loop};
  std::string called;
};

TEST_F(TurnQueueTest, LetsAClientBeginAtOnceUntilTheTimeIsUsedUp) {
  Client one(*this, "a", "1"), other(*this, "b", "2");
  EXPECT_TRUE(one.turn.may_begin());
  EXPECT_TRUE(other.turn.may_begin()) << "the first one has used no time";
  work();
  EXPECT_FALSE(other.turn.may_begin());
  EXPECT_FALSE(one.turn.may_begin()) << "others wait";
  run_turns(loop, 1);
  EXPECT_EQ(called, "1") << "one in a turn of the loop";
  run_turns(loop, 1);
  EXPECT_EQ(called, "12");
}

TEST_F(TurnQueueTest, CountsWorkWithinOtherWorkOnce) {
  Client one(*this, "a", "1");
  {
    const TurnQueue::Work outer(queue);
    { const TurnQueue::Work inner(queue); }
    EXPECT_TRUE(one.turn.may_begin());
    work();
    EXPECT_FALSE(one.turn.may_begin(TurnQueue::Reason::event));
  }
  EXPECT_FALSE(one.turn.may_begin());
}

TEST_F(TurnQueueTest, ServesOneAccountAfterAnotherHoweverManyClientsEachHas) {
  Client a1(*this, "a", "1"), a2(*this, "a", "2"), a3(*this, "a", "3"), b(*this, "b", "b");
  for (Client* one : {&a1, &a2, &a3, &b}) one->turn.wait();
  run_turns(loop, 6);
  EXPECT_EQ(called, "1b2b3b");
}

// However many always have more to do.
TEST_F(TurnQueueTest, ServesFirstWhoHasUsedLeast) {
  Client a1(*this, "a", "1"), a2(*this, "a", "2"), a3(*this, "a", "3");
  for (Client* one : {&a1, &a2, &a3}) one->turn.wait();
  run_turns(loop, 7);
  Client late(*this, "a", "4");
  late.turn.wait();
  called.clear();
  run_turns(loop, 2);
  EXPECT_NE(called.find('4'), std::string::npos) << called;
  // One that the machine kept from working for a while has used as much, and waits until the others
  // have, too.
  const auto was_called = [this](char name) { return called.find(name) != std::string::npos; };
  for (int i = 0; i < 10'000 && !(was_called('1') && was_called('2') && was_called('3')); ++i) {
    run_turns(loop, 1);
  }
  EXPECT_TRUE(was_called('1') && was_called('2') && was_called('3')) << called;
}

TEST_F(TurnQueueTest, ServesRequestsAndEventsInTurns) {
  Client a1(*this, "a", "1"), a2(*this, "a", "2"), a3(*this, "a", "3"), asks(*this, "a", "?");
  for (Client* one : {&a1, &a2, &a3, &asks}) one->turn.wait(TurnQueue::Reason::event);
  asks.turn.wait();
  asks.turn.wait(TurnQueue::Reason::event);  // still a request
  run_turns(loop, 2);
  EXPECT_EQ(called, "?1");
}

TEST_F(TurnQueueTest, ServesManyQuickClientsOfAnAccountInOneVisit) {
  // Again, because the machine may keep this process from working for longer than a visit.
  for (int attempt = 0; attempt < 1000 && called != "qqqb"; ++attempt) {
    std::list<TurnQueue::Turn> quick;
    for (int i = 0; i < 3; ++i) {
      quick.emplace_back(queue, "a", [this] { called += 'q'; }).wait();
    }
    Client b(*this, "b", "b");
    b.turn.wait();
    called.clear();
    run_turns(loop, 1);
  }
  EXPECT_EQ(called, "qqqb");
}

TEST_F(TurnQueueTest, ForgetsAClientThatHasStoppedOrIsGone) {
  Client one(*this, "a", "1");
  {
    Client gone(*this, "a", "2"), stopped(*this, "b", "3");
    for (Client* each : {&gone, &stopped, &one}) each->turn.wait();
    stopped.turn.stop();
    run_turns(loop, 1);
    EXPECT_EQ(called, "2");
  }
  run_turns(loop, 2);
  EXPECT_EQ(called, "211");
}

}  // namespace
}  // namespace dssm::daemon
