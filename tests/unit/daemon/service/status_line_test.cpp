// SPDX-License-Identifier: Apache-2.0
//
// The line of `systemctl status`: sent when it changed, after a pause, and only to a service
// manager that is there.
#include <gtest/gtest.h>

#include "daemon/service/service_manager.hpp"
#include "tests/support/inbox.hpp"
#include "tests/unit/daemon/run_loop.hpp"

namespace dssm::daemon {
namespace {

class StatusLineTest : public testing::Test {
 protected:
  void run_for(Duration time) {
    const MonoTime end = loop.deadline_in(time);
    EventSource timer = EventSource::timer(loop, [] {});
    timer.enable_in(time);
    run_until(loop, [&] { return loop.now() >= end; });
  }
  EventLoop loop = EventLoop::open(TimerQueue::Time::simulated).value();
  test::Inbox inbox;
  std::string text = "no streams";
  int made = 0;
  std::function<std::string()> make = [this] { return ++made, text; };
};

TEST_F(StatusLineTest, SendsSeveralChangesOnceAfterThePause) {
  ServiceManager manager{loop, inbox.path()};
  StatusLine line{loop, manager, make};
  EXPECT_EQ(line.now(), "no streams");
  text = "1 stream";
  line.touch();
  run_for(StatusLine::kPause / 2);
  text = "2 streams";
  line.touch();  // does not prolong the pause
  EXPECT_EQ(inbox.next(), "");
  run_for(StatusLine::kPause / 2);
  EXPECT_EQ(inbox.next(), "STATUS=2 streams");
  EXPECT_EQ(inbox.next(), "");
  EXPECT_EQ(made, 2);
}

TEST_F(StatusLineTest, DoesNotRepeatWhatWasSent) {
  ServiceManager manager{loop, inbox.path()};
  StatusLine line{loop, manager, make};
  line.now();
  line.touch();
  run_for(StatusLine::kPause + std::chrono::milliseconds(1));
  EXPECT_EQ(made, 2);
  EXPECT_EQ(inbox.next(), "");
  text = "1 stream";
  line.touch();  // a second time works as the first
  run_for(StatusLine::kPause + std::chrono::milliseconds(1));
  EXPECT_EQ(inbox.next(), "STATUS=1 stream");
}

TEST_F(StatusLineTest, MakesNoLineWithoutAServiceManager) {
  ServiceManager none{loop, ""};
  StatusLine line{loop, none, make};
  line.touch();
  run_for(StatusLine::kPause + std::chrono::milliseconds(1));
  EXPECT_EQ(made, 0);
}

}  // namespace
}  // namespace dssm::daemon
