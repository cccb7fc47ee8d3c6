// SPDX-License-Identifier: Apache-2.0
//
// Setting the clock of the machine that runs the tests is out of the question, so here is only
// tested that the kernel was asked for the right thing. The fleet's PCs set their clocks.
#include "daemon/clock/step_watch.hpp"

#include <event2/event.h>
#include <gtest/gtest.h>

#include <filesystem>
#include <fstream>
#include <sstream>

namespace dssm::daemon {
namespace {

// What the kernel says of this process's only timer by CLOCK_REALTIME.
std::string timer_info() {
  for (const auto& file : std::filesystem::directory_iterator("/proc/self/fdinfo")) {
    std::ostringstream text;
    text << std::ifstream(file.path()).rdbuf();
    if (text.str().find("clockid: 0\n") != std::string::npos) return text.str();
  }
  return "";
}

TEST(StepWatch, IsNotifiedWhenTheWallClockIsSet) {
  const EventLoop loop = EventLoop::open().value();
  int calls = 0;
  const auto watch = StepWatch::open(loop, [&] { ++calls; }).value();
  const std::string info = timer_info();
  ASSERT_NE(info, "");
  EXPECT_NE(info.find("settime flags: 03\n"), std::string::npos)
      << "TFD_TIMER_ABSTIME | TFD_TIMER_CANCEL_ON_SET; " << info;
  event_base_loop(loop.base(), EVLOOP_NONBLOCK);
  EXPECT_EQ(calls, 0);
}

}  // namespace
}  // namespace dssm::daemon
