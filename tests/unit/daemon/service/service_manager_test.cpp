// SPDX-License-Identifier: Apache-2.0
//
// Messages to systemd and to its journal: what they hold, and that nobody waits for them.
#include "daemon/service/service_manager.hpp"

#include <gtest/gtest.h>

#include "daemon/base/log.hpp"
#include "tests/support/inbox.hpp"

namespace dssm::daemon {
namespace {

class ServiceManagerTest : public testing::Test {
 protected:
  // Until the manager takes nothing more.
  int fill() {
    int sent = 0;
    for (; manager.waiting() == 0 && sent < 100'000; ++sent) manager.status(std::to_string(sent));
    return sent;
  }
  EventLoop loop = EventLoop::open().value();
  test::Inbox inbox;
  ServiceManager manager{loop, inbox.path()};
};

TEST_F(ServiceManagerTest, SendsWhatSystemdUnderstands) {
  manager.ready("all\nis well");
  EXPECT_EQ(inbox.next(), "READY=1\nSTATUS=all?is well");
  manager.reloading();
  EXPECT_TRUE(inbox.next().starts_with("RELOADING=1\nMONOTONIC_USEC="));
  manager.keep("abc", {0});
  EXPECT_EQ(inbox.next(), "FDSTORE=1\nFDPOLL=0\nFDNAME=abc");
  manager.forget("abc");
  EXPECT_EQ(inbox.next(), "FDSTOREREMOVE=1\nFDNAME=abc");
  manager.alive();
  EXPECT_EQ(inbox.next(), "WATCHDOG=1");
}

TEST_F(ServiceManagerTest, SendsLaterAndInOrderWhatIsNotTakenAtOnce) {
  const int before = fill();
  ASSERT_EQ(manager.waiting(), 1u);
  manager.status("later");
  manager.alive();  // worthless later
  EXPECT_EQ(manager.waiting(), 2u);
  EventSource look = EventSource::timer(loop, [&] {
    if (manager.waiting() == 0) return loop.stop();
    look.enable_in(std::chrono::milliseconds(1));
  });
  for (int i = 0; i < before - 1; ++i) EXPECT_EQ(inbox.next(), "STATUS=" + std::to_string(i));
  look.enable_in(Duration::zero());
  ASSERT_TRUE(loop.run());
  EXPECT_EQ(inbox.next(), "STATUS=" + std::to_string(before - 1));
  EXPECT_EQ(inbox.next(), "STATUS=later");
  EXPECT_EQ(inbox.next(), "");
}

TEST_F(ServiceManagerTest, DoesNotKeepWhatIsForgottenBeforeItWasSent) {
  fill();
  manager.keep("abc", {0});
  EXPECT_EQ(manager.waiting(), 2u);
  manager.forget("abc");
  EXPECT_EQ(manager.waiting(), 1u);
}

TEST(NoServiceManager, IsNotMissed) {
  EventLoop loop = EventLoop::open().value();
  for (const std::string path : {"", "nonsense", "/nowhere/notify"}) {
    ServiceManager manager(loop, path);
    manager.ready("up");
    manager.keep("abc", {0});
    EXPECT_EQ(manager.waiting(), 0u);
  }
}

TEST(JournalLogger, WritesFieldsThatCanBeSearched) {
  test::Inbox inbox;
  JournalLogger logger(LogLevel::info, inbox.path());
  logger.warning("hot\nPRIORITY=0", {.stream = "s:0@pc1", .peer = "'x'", .message_id = "0123"});
  EXPECT_EQ(inbox.next(),
            "MESSAGE=hot?PRIORITY=0\nPRIORITY=4\nSYSLOG_IDENTIFIER=dssmd\nMESSAGE_ID=0123\n"
            "DSSM_STREAM=s:0@pc1\nDSSM_PEER='x'\n");
  logger.debug("quiet");
  EXPECT_EQ(inbox.next(), "");
  logger.set_level(LogLevel::debug);
  logger.debug("loud");
  EXPECT_EQ(inbox.next(), "MESSAGE=loud\nPRIORITY=7\nSYSLOG_IDENTIFIER=dssmd\n");
}

TEST(JournalLogger, DoesNotWaitForAJournalThatHangs) {
  test::Inbox inbox;  // nobody takes anything
  JournalLogger logger(LogLevel::info, inbox.path());
  testing::internal::CaptureStderr();
  for (int i = 0; i < 10'000; ++i) logger.info("line");
  EXPECT_NE(testing::internal::GetCapturedStderr().find("<6>line\n"), std::string::npos);
}

}  // namespace
}  // namespace dssm::daemon
