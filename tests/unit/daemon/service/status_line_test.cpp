// SPDX-License-Identifier: Apache-2.0
//
// The line of `systemctl status`: told when it changed, after a pause, and to nobody who did not
// ask.
#include <gtest/gtest.h>

#include "daemon/service/service_manager.hpp"
#include "tests/support/inbox.hpp"

namespace dssm::daemon {
namespace {

class StatusLineTest : public testing::Test {
 protected:
  void run_for(Duration time) {
    EventSource end = EventSource::timer(loop, [&] { loop.stop(); });
    end.enable_in(time);
    ASSERT_TRUE(loop.run());
  }
  EventLoop loop = EventLoop::open().value();
  test::Inbox inbox;
  std::string text = "no streams";
  int made = 0;
  std::function<std::string()> make = [this] { return ++made, text; };
};

TEST_F(StatusLineTest, TellsSeveralChangesOnceAfterThePause) {
  ServiceManager manager{loop, inbox.path()};
  StatusLine line{loop, manager, make};
  EXPECT_EQ(line.now(), "no streams");
  text = "1 stream";
  line.touch();
  text = "2 streams";
  line.touch();
  EXPECT_EQ(inbox.next(), "");
  run_for(StatusLine::kPause + std::chrono::milliseconds(1));
  EXPECT_EQ(inbox.next(), "STATUS=2 streams");
  EXPECT_EQ(inbox.next(), "");
  EXPECT_EQ(made, 2);
}

TEST_F(StatusLineTest, DoesNotRepeatWhatWasTold) {
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

TEST_F(StatusLineTest, MakesNoLineThatNobodyReads) {
  ServiceManager nobody{loop, ""};
  StatusLine line{loop, nobody, make};
  line.touch();
  run_for(StatusLine::kPause + std::chrono::milliseconds(1));
  EXPECT_EQ(made, 0);
}

}  // namespace
}  // namespace dssm::daemon
