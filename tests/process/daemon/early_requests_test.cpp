// SPDX-License-Identifier: Apache-2.0
//
// Requests by signal to a dssmd that has just made its socket and is not ready yet.
#include <gtest/gtest.h>
#include <poll.h>
#include <signal.h>
#include <sys/syscall.h>
#include <unistd.h>

#include <filesystem>
#include <fstream>

#include "core/base/unique_fd.hpp"
#include "tests/support/daemon_process.hpp"

namespace dssm::test {
namespace {

// Several, because it is the scheduler's to say how far dssmd comes before the signal.
constexpr int kTries = 5;

// ThreadSanitizer (g++ 12) sets up a thread's table of signals at the first call that may block. A
// signal that comes in the midst of that goes into a table of its own, which is then dropped; the
// next signal is taken. (strace shows it: one mmap() of that size within another.)
#ifdef __SANITIZE_THREAD__
constexpr bool kForgetsFirstSignal = true;
#else
constexpr bool kForgetsFirstSignal = false;
#endif
constexpr int kSurelyForgottenMs = 20'000;

class EarlyRequest : public testing::Test {
 protected:
  EarlyRequest() {
    std::ofstream(dir_ + "/dssmd.toml") << "mdns = false\nlisten = []\nchronyd = \"127.0.0.1:1\"\n";
  }
  ~EarlyRequest() override { remove_tree(dir_); }

  bool has_socket() const { return ::access((dir_ + "/dssmd.sock").c_str(), F_OK) == 0; }

  // Sends the signals as soon as the socket is there, which leaves no time for a pause between two
  // looks; the exit status, as a shell shows it.
  int start_and_send(const std::vector<int>& signals) {
    const pid_t pid = start({built("daemon/dssmd"), "--config", dir_ + "/dssmd.toml",
                             "--runtime-dir", dir_, "--name", "pc1"});
    while (!has_socket()) continue;
    for (const int number : signals) ::kill(pid, number);
    if (kForgetsFirstSignal && !ends_within(pid, kSurelyForgottenMs)) ::kill(pid, signals.back());
    return wait_for(pid);
  }

 private:
  static bool ends_within(pid_t pid, int timeout_ms) {
    const UniqueFd process(static_cast<int>(::syscall(SYS_pidfd_open, pid, 0)));
    pollfd end{process.get(), POLLIN, 0};
    return ::poll(&end, 1, timeout_ms) == 1;
  }

  const std::string dir_ = make_temp_dir();
};

TEST_F(EarlyRequest, ToStopEndsItAsAtAnyTime) {
  for (int i = 0; i < kTries; ++i) {
    for (const int number : {SIGTERM, SIGINT}) {
      ASSERT_EQ(start_and_send({number}), 0);
      ASSERT_FALSE(has_socket());
    }
  }
}

TEST_F(EarlyRequest, ToReloadItsConfigurationDoesNotEndIt) {
  for (int i = 0; i < kTries; ++i) ASSERT_EQ(start_and_send({SIGHUP, SIGTERM}), 0);
}

}  // namespace
}  // namespace dssm::test
