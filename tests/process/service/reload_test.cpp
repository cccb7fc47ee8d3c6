// SPDX-License-Identifier: Apache-2.0
//
// dssmd's notifications to the service manager: watchdog, status line, reloads.
#include <gtest/gtest.h>

#include <algorithm>
#include <csignal>
#include <cstdio>
#include <dssm/dssm.hpp>
#include <fstream>

#include "tests/support/await.hpp"
#include "tests/support/daemon_process.hpp"
#include "tests/support/service_manager.hpp"
#include "tests/support/session.hpp"

namespace dssm::test {
namespace {

using namespace std::chrono_literals;

// A configuration file that can be changed.
class ConfigurationFile {
 public:
  explicit ConfigurationFile(const std::string& text) { write(text); }
  ConfigurationFile(const ConfigurationFile&) = delete;
  ConfigurationFile& operator=(const ConfigurationFile&) = delete;
  ~ConfigurationFile() { remove_tree(dir_); }
  void write(const std::string& text) const { std::ofstream(path()) << text; }
  std::string path() const { return dir_ + "/dssmd.conf"; }

 private:
  std::string dir_ = make_temp_dir();
};

// The number of messages that begin with `begin`.
std::size_t count(const ServiceManager::Messages& messages, const std::string& begin) {
  return static_cast<std::size_t>(
      std::count_if(messages.begin(), messages.end(),
                    [&](const std::string& message) { return message.starts_with(begin); }));
}

// Requests a reload and waits for its end.
void reload(ServiceManager& manager) {
  const std::size_t before = count(manager.messages(), "READY=1");
  manager.signal(SIGHUP);
  manager.await([&](const auto& messages) { return count(messages, "READY=1") > before; });
}

TEST(WatchdogMessages, AreSentWhileTheLoopRunsAndNotWhileItHangs) {
  ServiceManager manager({.arguments = {"--listen", ""}, .watchdog_us = 200'000});
  EXPECT_TRUE(manager.says_within("WATCHDOG=1", 60s));
  EXPECT_TRUE(manager.says_within("WATCHDOG=1", 60s));
  manager.signal(SIGSTOP);
  // Skips messages from before the stop. Three intervals: systemd would have restarted dssmd.
  EXPECT_FALSE(manager.says_within("WATCHDOG=1", 600ms));
  manager.signal(SIGCONT);
  EXPECT_TRUE(manager.says_within("WATCHDOG=1", 60s));
}

TEST(WatchdogMessages, AreNotSentWithoutAWatchdog) {
  ServiceManager manager({.arguments = {"--listen", ""}});
  connect_to(manager.socket_path()).list_streams().value();
  EXPECT_EQ(count(manager.messages(), "WATCHDOG=1"), 0u);
}

TEST(StatusLine, ShowsStreamsHostsAndClock) {
  DaemonProcess pc2({}, "pc2");
  ServiceManager manager({.arguments = {"--peer", pc2.address(), "--listen", "127.0.0.1:0"}});
  manager.await_status("1 of 1 other hosts up, clock unknown");
  Session session = connect_to(manager.socket_path());
  session.create<int>("a", kShort).value();
  session.create<int>("b", kShort).value();
  manager.await_status("host 'pc1', 2 streams, 1 of 1 other hosts up");
  ASSERT_TRUE(session.remove({"a", 0, ""}));
  pc2.kill_hard();
  manager.await_status("host 'pc1', 1 streams, 0 of 1 other hosts up");
}

TEST(StatusLine, IsNotRepeatedForEachOfManyChanges) {
  ServiceManager manager({.arguments = {"--listen", ""}});
  Session session = connect_to(manager.socket_path());
  for (int i = 0; i < 100; ++i) {
    ASSERT_TRUE(session.create<int>("s" + std::to_string(i), kShort));
  }
  manager.await_status(" 100 streams");
  EXPECT_LE(count(manager.messages(), "STATUS="), 50u) << "one line per change would be 100";
}

TEST(Reload, AppliesKeysThatCanChangeAtOnce) {
  const ConfigurationFile file("listen = []\nmax_streams = 1\n");
  ServiceManager manager({.arguments = {"--config", file.path()}});
  Session session = connect_to(manager.socket_path());
  ASSERT_TRUE(session.create<int>("a", kShort));
  EXPECT_EQ(session.create<int>("b", kShort).error().code, Errc::limit_exceeded);
  file.write("listen = []\nmax_streams = 2\n");
  reload(manager);
  EXPECT_TRUE(session.create<int>("b", kShort));
  EXPECT_EQ(session.create<int>("c", kShort).error().code, Errc::limit_exceeded);
  const auto messages = manager.messages();
  const auto reloading =
      std::find_if(messages.begin(), messages.end(), [](const std::string& message) {
        return message.starts_with("RELOADING=1\nMONOTONIC_USEC=");
      });
  ASSERT_NE(reloading, messages.end());
  EXPECT_EQ(count({reloading, messages.end()}, "READY=1"), 1u) << "it is not ready once after that";
}

TEST(Reload, KeepsTheOldConfigurationWhenTheNewOneHasMistakes) {
  const ConfigurationFile file("listen = []\nmax_streams = 1\n");
  ServiceManager manager({.arguments = {"--config", file.path()}});
  Session session = connect_to(manager.socket_path());
  file.write("listen = []\nmax_streams = 0\ncolour = 1\n");
  reload(manager);
  ASSERT_TRUE(session.create<int>("a", kShort));
  EXPECT_EQ(session.create<int>("b", kShort).error().code, Errc::limit_exceeded);
}

TEST(Reload, ConnectsToNewPeersAndDropsOldOnes) {
  DaemonProcess pc2({}, "pc2"), pc3({}, "pc3");
  const std::string head = "listen = []\nmdns = false\npeers = ";
  const ConfigurationFile file(head + "[\"" + pc2.address() + "\"]\n");
  ServiceManager manager({.arguments = {"--config", file.path()}});
  Session session = connect_to(manager.socket_path());
  const auto await_hosts = [&](const std::vector<std::string>& names) {
    await([&] {
      std::vector<std::string> up;
      for (const HostInfo& host : session.list_hosts().value()) {
        if (host.state == HostState::up) up.push_back(host.name);
      }
      return up == names && session.list_hosts().value().size() == names.size() + 1;
    });
  };
  await_hosts({"pc2"});
  file.write(head + "[\"" + pc2.address() + "\", \"" + pc3.address() + "\"]\n");
  reload(manager);
  await_hosts({"pc2", "pc3"});
  file.write(head + "[\"" + pc3.address() + "\"]\n");
  reload(manager);
  await_hosts({"pc3"});
  file.write(head + "[]\n");
  reload(manager);
  await_hosts({});
  file.write(head + "[\"" + pc2.address() + "\"]\n");
  reload(manager);
  await_hosts({"pc2"});
}

}  // namespace
}  // namespace dssm::test
