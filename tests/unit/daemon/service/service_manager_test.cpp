// SPDX-License-Identifier: Apache-2.0
//
// Messages to systemd and to its journal: what they hold, and that sending
// them does not block.
#include "daemon/service/service_manager.hpp"

#include <gtest/gtest.h>

#include <filesystem>

#include "daemon/base/log.hpp"
#include "tests/support/inbox.hpp"
#include "tests/unit/daemon/run_loop.hpp"

namespace dssm::daemon {
namespace {

class ServiceManagerTest : public testing::Test {
 protected:
  // Fills the manager's socket, as other services do while it is busy: it takes nothing more.
  void fill() {
    // The kernel limits the messages of each sender as well as those of the receiver.
    for (bool took = true; took;) {
      const UniqueFd sender(::socket(AF_UNIX, SOCK_DGRAM | SOCK_NONBLOCK | SOCK_CLOEXEC, 0));
      const sockaddr_un to = inbox.address();
      ASSERT_EQ(::connect(sender.get(), reinterpret_cast<const sockaddr*>(&to), sizeof to), 0);
      for (took = false; ::send(sender.get(), "full", 4, 0) == 4;) took = true;
    }
  }
  // What arrives until `last` does, while the manager reads.
  std::vector<std::string> received_until(const std::string& last) {
    std::vector<std::string> texts;
    run_until(loop, [&] {
      for (std::string text = inbox.next(); !text.empty(); text = inbox.next()) {
        if (text != "full") texts.push_back(text);
      }
      return !texts.empty() && texts.back() == last;
    });
    return texts;
  }
  EventLoop loop = EventLoop::open(TimerQueue::Time::simulated).value();
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
  fill();
  manager.status("0");
  manager.status("1");
  manager.alive();  // worthless later
  manager.status("2");
  EXPECT_EQ(received_until("STATUS=2"),
            (std::vector<std::string>{"STATUS=0", "STATUS=1", "STATUS=2"}));
}

TEST_F(ServiceManagerTest, DoesNotKeepWhatIsForgottenBeforeItWasSent) {
  fill();
  manager.status("first");
  manager.keep("abc", {0});
  manager.forget("abc");
  manager.status("last");
  EXPECT_EQ(received_until("STATUS=last"),
            (std::vector<std::string>{"STATUS=first", "STATUS=last"}));
}

TEST_F(ServiceManagerTest, QueuesNothingWhileThereIsNoManager) {
  const std::string away = inbox.path() + "-away";
  std::filesystem::rename(inbox.path(), away);
  manager.ready("up");
  manager.keep("abc", {0});
  std::filesystem::rename(away, inbox.path());
  manager.status("later");
  EXPECT_EQ(received_until("STATUS=later"), std::vector<std::string>{"STATUS=later"});
}

TEST(NoServiceManager, IsNotMissed) {
  EventLoop loop = EventLoop::open().value();
  for (const std::string path : {"", "nonsense", "/nowhere/notify"}) {
    ServiceManager manager(loop, path);
    manager.ready("up");
    manager.keep("abc", {0});
    EXPECT_EQ(manager.is_there(), path == "/nowhere/notify");
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
