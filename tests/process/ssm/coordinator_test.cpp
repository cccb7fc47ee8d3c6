// SPDX-License-Identifier: Apache-2.0
//
// ssm-coordinator as scripts use it: start it, find it by its name, stop it by a signal.
#include <fcntl.h>
#include <gtest/gtest.h>
#include <poll.h>
#include <signal.h>
#include <unistd.h>

#include <cstdlib>
#include <dssm/session.hpp>
#include <filesystem>
#include <fstream>
#include <sstream>

#include "tests/support/await.hpp"
#include "tests/support/daemon_process.hpp"

namespace dssm::test {
namespace {

const std::string& coordinator() {
  static const std::string path = built("client/ssm/ssm-coordinator");
  return path;
}

// A running coordinator in a folder of its own.
class Coordinator {
 public:
  explicit Coordinator(std::vector<std::string> options = {},
                       const std::string& program = coordinator()) {
    std::vector<std::string> command = {program};
    command.insert(command.end(), options.begin(), options.end());
    int out[2];
    if (::pipe2(out, O_CLOEXEC)) std::abort();
    pid = start(command, {environment()}, out[1]);
    ::close(out[1]);
    out_ = out[0];
  }
  ~Coordinator() {
    if (pid > 0) ::kill(pid, SIGTERM), wait_for(pid);
    ::close(out_);
    remove_tree(folder);
  }

  std::string environment() const { return "DSSM_SOCKET=" + folder + "/dssmd.sock"; }

  // Reads on until `word` was printed, or all there is; what was printed so far.
  std::string read_until(const std::string& word) {
    char buffer[512];
    while (text_.find(word) == std::string::npos) {
      const ssize_t n = ::read(out_, buffer, sizeof buffer);
      if (n <= 0) break;
      text_.append(buffer, static_cast<std::size_t>(n));
    }
    return text_;
  }

  // dssmd's pid, from the words that the old coordinator printed.
  pid_t dssmd() {
    const std::string before = "Msg queue ID = ";
    read_until(before);
    const std::string text = read_until("\n" + std::string());
    std::istringstream number(text.substr(text.find(before) + before.size()));
    pid_t id = 0;
    number >> id;
    return id;
  }

  int signal_and_wait(int signal) {
    ::kill(pid, signal);
    const int status = wait_for(pid);
    pid = -1;
    return status;
  }

  const std::string folder = make_temp_dir();
  pid_t pid = -1;

 private:
  int out_ = -1;
  std::string text_;
};

// Waits until the process is gone, or a zombie of somebody else.
void await_end(pid_t pid) {
  for (;;) {
    std::ifstream stat("/proc/" + std::to_string(pid) + "/stat");
    std::string line;
    if (!std::getline(stat, line) || line.find(") Z ") != std::string::npos) return;
    ::poll(nullptr, 0, 1);
  }
}

TEST(SsmCoordinator, PrintsItsVersionAndExitsWithOne) {
  const Finished finished = run({coordinator(), "--version"});
  EXPECT_EQ(finished.out, " Ver. " DSSM_VERSION "\n");
  EXPECT_EQ(finished.exit_status, 1);
}

TEST(SsmCoordinator, ExitsWithOneForHelpAndForWhatItDoesNotKnow) {
  for (const char* option : {"-h", "--help", "-z", "--nonsense", "stray"}) {
    const Finished finished = run({coordinator(), option});
    EXPECT_EQ(finished.exit_status, 1) << option;
    EXPECT_EQ(finished.out, "") << option;
    EXPECT_NE(finished.err, "") << option;
  }
}

TEST(SsmCoordinator, PrintsTheOldBannerAndServesUntilSigintOrSigterm) {
  for (const int signal : {SIGINT, SIGTERM}) {
    Coordinator running({"--without-check-msgque"});
    const std::string banner = running.read_until("Msg queue ID");
    EXPECT_NE(banner.find("SSM ( Streaming data Sharing Manager )\n Ver. " DSSM_VERSION "\n"),
              std::string::npos);
    EXPECT_NE(banner.find("Message queue ready.\n"), std::string::npos);
    const std::string folder = make_temp_dir();
    const Finished program =
        run({built("tests/process/ssm/cpp_traps-c++20"), folder}, {running.environment()});
    EXPECT_EQ(program.exit_status, 0) << program.out << program.err;
    remove_tree(folder);
    const pid_t dssmd = running.dssmd();
    EXPECT_EQ(running.signal_and_wait(signal), 0);
    EXPECT_NE(running.read_until("exit\n").find("program stop ["), std::string::npos);
    await_end(dssmd);
  }
}

TEST(SsmCoordinator, ReportsThatOneIsRunningAlready) {
  Coordinator running({"-q"});
  await([&] {
    return Session::connect({.socket_path = running.folder + "/dssmd.sock"}).has_value();
  });
  const Finished second = run({coordinator()}, {running.environment()});
  EXPECT_NE(second.err.find("is running already"), std::string::npos) << second.err;
  EXPECT_EQ(second.exit_status, 255);
  EXPECT_NE(second.err.find(running.folder), std::string::npos) << second.err;
  EXPECT_EQ(running.signal_and_wait(SIGINT), 0);
  EXPECT_EQ(running.read_until("anything"), "");
}

// A dssmd that has not come to its own handlers yet ends by the signal.
TEST(SsmCoordinator, EndsWellWhenItIsStoppedBeforeItsDssmdIsReady) {
  const std::string programs = make_temp_dir();
  std::filesystem::copy(coordinator(), programs);
  std::ofstream(programs + "/dssmd") << "#!/bin/sh\necho started\nexec sleep 1000\n";
  std::filesystem::permissions(programs + "/dssmd", std::filesystem::perms::owner_all);
  for (const int signal : {SIGINT, SIGTERM, SIGHUP}) {
    Coordinator running({}, programs + "/ssm-coordinator");
    ASSERT_NE(running.read_until("started").find("started"), std::string::npos);
    EXPECT_EQ(running.signal_and_wait(signal), 0);
  }
  remove_tree(programs);
}

TEST(SsmCoordinator, IsFoundByItsName) {
  Coordinator running;
  running.read_until("ready");
  std::ifstream comm("/proc/" + std::to_string(running.pid) + "/comm");
  std::string name;
  std::getline(comm, name);
  EXPECT_EQ(name, "ssm-coordinator");
}

TEST(SsmCoordinator, TakesItsDssmdAlongWhenItIsKilled) {
  Coordinator running;
  const pid_t dssmd = running.dssmd();
  ASSERT_GT(dssmd, 0);
  EXPECT_EQ(running.signal_and_wait(SIGKILL), 128 + SIGKILL);
  await_end(dssmd);
}

TEST(SsmCoordinator, EndsWithItsDssmd) {
  Coordinator running;
  const pid_t dssmd = running.dssmd();
  ASSERT_GT(dssmd, 0);
  ::kill(dssmd, SIGKILL);
  EXPECT_EQ(wait_for(running.pid), 255);
  running.pid = -1;
}

TEST(SsmCoordinator, RefusesASocketNameThatDssmdDoesNotMake) {
  const Finished finished = run({coordinator()}, {"DSSM_SOCKET=/tmp/other.sock"});
  EXPECT_EQ(finished.exit_status, 255);
  EXPECT_NE(finished.err.find("/tmp/other.sock"), std::string::npos) << finished.err;
}

TEST(SsmCoordinator, PassesOnWhyDssmdCannotStart) {
  const Finished finished = run({coordinator()}, {"DSSM_SOCKET=/proc/nowhere/dssmd.sock"});
  EXPECT_EQ(finished.exit_status, 255);
  EXPECT_NE(finished.err.find("/proc/nowhere"), std::string::npos) << finished.err;
}

}  // namespace
}  // namespace dssm::test
