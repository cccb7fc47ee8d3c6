// SPDX-License-Identifier: Apache-2.0
//
// How dssmd starts, refuses to start, and stops.
#include <fcntl.h>
#include <gtest/gtest.h>
#include <signal.h>
#include <sys/stat.h>
#include <sys/wait.h>
#include <unistd.h>

#include <filesystem>
#include <fstream>
#include <set>

#include "tests/process/daemon/raw_client.hpp"

namespace dssm::test {
namespace {

Finished dssmd(std::vector<std::string> words) {
  words.insert(words.begin(), built("daemon/dssmd"));
  return run(words);
}

TEST(Flags, PrintVersionAndHelp) {
  const Finished version = dssmd({"--version"});
  EXPECT_EQ(version.exit_status, 0);
  EXPECT_EQ(version.out, "dssmd " DSSM_VERSION "\n");
  EXPECT_EQ(version.err, "");
  const Finished help = dssmd({"--help"});
  EXPECT_EQ(help.exit_status, 0);
  EXPECT_NE(help.out.find("--runtime-dir DIR"), std::string::npos);
}

TEST(Flags, CheckAConfigurationWithoutStarting) {
  const std::string dir = make_temp_dir(), path = dir + "/dssmd.conf";
  std::ofstream(path) << "name = \"pc1\"\nruntime_dir = \"" << dir << "/run\"\n";
  const Finished good = dssmd({"--config", path, "--check-config"});
  EXPECT_EQ(good.exit_status, 0);
  EXPECT_EQ(good.out, "OK\n");
  EXPECT_EQ(good.err, "");
  EXPECT_FALSE(std::filesystem::exists(dir + "/run"));

  std::ofstream(path) << "name = \"pc1\"\nmax_streams = 0\ncolour = 1\n";
  const Finished bad = dssmd({"--config", path, "--check-config"});
  EXPECT_EQ(bad.exit_status, 2);
  EXPECT_EQ(bad.out, "");
  EXPECT_NE(bad.err.find("dssmd: " + path + ":2: key 'max_streams': '0'"), std::string::npos)
      << bad.err;
  EXPECT_NE(bad.err.find("dssmd: " + path + ":3: key 'colour'"), std::string::npos) << bad.err;
  remove_tree(dir);
}

TEST(Flags, RefuseToStartWithWrongOnes) {
  EXPECT_EQ(dssmd({"--colour"}).exit_status, 2);
  EXPECT_EQ(dssmd({"--name", "a.b"}).exit_status, 2);
  EXPECT_EQ(dssmd({"--config", "/nowhere/dssmd.conf"}).exit_status, 2);
}

TEST(Flags, FailWithOneWhereTheFolderCannotBe) {
  const Finished finished = dssmd({"--runtime-dir", "/nowhere/at/all"});
  EXPECT_EQ(finished.exit_status, 1);
  EXPECT_NE(finished.err.find("'/nowhere/at/all'"), std::string::npos) << finished.err;
}

TEST(Start, ReportsThatItIsReadyWithHostAndSocket) {
  const std::string dir = make_temp_dir();
  int ends[2];
  ASSERT_EQ(::pipe2(ends, O_CLOEXEC), 0);
  const pid_t pid = ::fork();
  if (pid == 0) {
    ::dup2(ends[1], 2);
    const std::string program = built("daemon/dssmd");
    ::execl(program.c_str(), "dssmd", "--runtime-dir", dir.c_str(), "--name", "pc9", "--listen", "",
            nullptr);
    ::_exit(127);
  }
  ::close(ends[1]);
  std::string text;
  char c = 0;
  while (text.find('\n') == text.npos && ::read(ends[0], &c, 1) == 1) text += c;
  EXPECT_EQ(text, "dssmd: ready, host 'pc9', socket '" + dir + "/dssmd.sock', no network\n");
  ::kill(pid, SIGTERM);
  EXPECT_EQ(wait_for(pid), 0);
  ::close(ends[0]);
  remove_tree(dir);
}

TEST(Start, RefusesToBeTheSecondInOneFolder) {
  DaemonProcess first;
  const Finished second = dssmd({"--runtime-dir", first.runtime_dir(), "--name", "pc2"});
  EXPECT_EQ(second.exit_status, 1);
  EXPECT_NE(second.err.find("another dssmd is running there"), std::string::npos) << second.err;
  EXPECT_NE(second.err.find(first.runtime_dir()), std::string::npos);
  RawClient client(first.socket_path());  // the first one does not notice
  EXPECT_TRUE(client.ask(list_request()).response.has_stream_list());
}

TEST(Start, TakesOverFromADssmdThatWasKilled) {
  DaemonProcess daemon;
  daemon.kill_hard();
  EXPECT_TRUE(std::filesystem::exists(daemon.socket_path())) << "its socket is left";
  daemon.start();
  RawClient client(daemon.socket_path());
  EXPECT_TRUE(client.ask(list_request()).response.has_stream_list());
}

TEST(Start, DoesNotRemoveAFileThatIsNoSocket) {
  const std::string dir = make_temp_dir();
  std::ofstream(dir + "/dssmd.sock") << "precious";
  const Finished finished = dssmd({"--runtime-dir", dir, "--name", "pc1"});
  EXPECT_EQ(finished.exit_status, 1);
  EXPECT_NE(finished.err.find("not a socket"), std::string::npos) << finished.err;
  EXPECT_TRUE(std::filesystem::exists(dir + "/dssmd.sock"));
  remove_tree(dir);
}

TEST(Start, RunsBesideOthersInFoldersOfTheirOwn) {
  DaemonProcess one({}, "pc1"), two({}, "pc2");
  RawClient at_one(one.socket_path()), at_two(two.socket_path());
  EXPECT_TRUE(at_one.ask(create_request("odometry")).response.opened().created());
  EXPECT_TRUE(at_two.ask(create_request("odometry")).response.opened().created());
  EXPECT_EQ(at_two.ask(list_request()).response.stream_list().streams(0).id().host(), "pc2");
}

std::set<std::string> files_in(const std::string& folder) {
  std::set<std::string> names;
  for (const auto& entry : std::filesystem::directory_iterator(folder)) {
    names.insert(entry.path().filename());
  }
  return names;
}

TEST(Stop, LeavesNothingInTheFolderButWhatTheNextOneHasToKnowOfTheClock) {
  DaemonProcess daemon;
  EXPECT_EQ(daemon.stop(), 0);
  EXPECT_EQ(files_in(daemon.runtime_dir()), std::set<std::string>{"clock"});
}

TEST(Stop, LeavesTheSocketWhenProgramsMayHoldStreams) {
  DaemonProcess daemon;
  RawClient client(daemon.socket_path());
  client.ask(create_request("odometry"));
  EXPECT_EQ(daemon.stop(), 0);
  EXPECT_EQ(files_in(daemon.runtime_dir()), (std::set<std::string>{"clock", "dssmd.sock"}));
}

TEST(Stop, ComesByControlCAsWell) {
  DaemonProcess daemon;
  ::kill(daemon.pid(), SIGINT);
  siginfo_t end{};
  ASSERT_EQ(::waitid(P_PID, static_cast<id_t>(daemon.pid()), &end, WEXITED | WNOWAIT), 0);
  EXPECT_EQ(end.si_code, CLD_EXITED);
  EXPECT_EQ(end.si_status, 0);
}

}  // namespace
}  // namespace dssm::test
