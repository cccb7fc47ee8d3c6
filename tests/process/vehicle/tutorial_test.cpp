// SPDX-License-Identifier: Apache-2.0
//
// The programs of docs/tutorial.md, extracted from its text, and those of docs/examples/loops
// exchange samples.
#include <fcntl.h>
#include <gtest/gtest.h>
#include <signal.h>
#include <unistd.h>

#include <algorithm>
#include <chrono>
#include <cstdio>
#include <cstdlib>
#include <memory>
#include <regex>
#include <string>
#include <vector>

#include "tests/support/daemon_process.hpp"

namespace {

constexpr std::size_t kEnough = 4;

std::string program(const std::string& name) {
  const bool is_example = name.find('/') != std::string::npos;
  return dssm::test::built(is_example ? name : "tests/process/vehicle/tutorial_" + name);
}

// A program whose output the test reads line by line. It writes to a terminal, because it would
// write to a pipe only when a buffer is full.
class Reading {
 public:
  Reading(const std::string& name, const dssm::test::DaemonProcess& daemon) {
    const int terminal = ::posix_openpt(O_RDWR | O_NOCTTY | O_CLOEXEC);
    EXPECT_EQ(::grantpt(terminal), 0);
    EXPECT_EQ(::unlockpt(terminal), 0);
    const int its_end = ::open(::ptsname(terminal), O_RDWR | O_NOCTTY | O_CLOEXEC);
    pid_ = dssm::test::start({program(name)}, {daemon.environment()}, its_end);
    ::close(its_end);
    output_ = ::fdopen(terminal, "r");
  }
  Reading(const Reading&) = delete;
  Reading& operator=(const Reading&) = delete;
  ~Reading() {
    std::fclose(output_);
    end(pid_);
  }

  static void end(pid_t pid) {
    ::kill(pid, SIGTERM);
    dssm::test::wait_for(pid);
  }

  // Appends the lines that it prints, until there are kEnough or it ends. Returns the time since
  // the last line.
  std::chrono::steady_clock::duration take(std::vector<std::string>& lines) {
    char line[256];
    auto last = std::chrono::steady_clock::now();
    while (lines.size() < kEnough && std::fgets(line, sizeof line, output_)) {
      lines.push_back(line);
      last = std::chrono::steady_clock::now();
    }
    return std::chrono::steady_clock::now() - last;
  }

 private:
  pid_t pid_;
  std::FILE* output_;
};

// Starts both, the reader first, each with its dssmd, and returns the first lines that the reader
// prints; fewer if it ends early.
std::vector<std::string> lines_read(const std::string& reader,
                                    const dssm::test::DaemonProcess& readers_daemon,
                                    const std::string& writer,
                                    const dssm::test::DaemonProcess& writers_daemon) {
  // An SSM reader ends after a second without a sample, which may also happen on a busy machine;
  // then it is started again.
  constexpr auto kReadNextTimeout = std::chrono::milliseconds(900);
  std::vector<std::string> lines;
  auto reading = std::make_unique<Reading>(reader, readers_daemon);
  const pid_t writing = dssm::test::start({program(writer)}, {writers_daemon.environment()});
  while (reading->take(lines) > kReadNextTimeout && lines.size() < kEnough) {
    reading = std::make_unique<Reading>(reader, readers_daemon);
  }
  reading.reset();
  Reading::end(writing);
  return lines;
}

class Tutorial : public testing::TestWithParam<std::pair<const char*, const char*>> {};

void expect_climate(const std::vector<std::string>& lines) {
  ASSERT_EQ(lines.size(), kEnough);
  const std::regex expected(R"(\d+: (19|20|21)\.\d\d degrees, [+-]0\.\d\d in a second\r\n)");
  for (const std::string& line : lines) EXPECT_TRUE(std::regex_match(line, expected)) << line;
}

TEST(Tutorials, InterpolateBetweenTwoSamples) {
  const dssm::test::DaemonProcess daemon;
  const std::vector<std::string> lines = lines_read("between", daemon, "writer", daemon);
  ASSERT_EQ(lines.size(), kEnough);
  for (const std::string& line : lines) {
    double value = 0, before = 0, after = 0;
    ASSERT_EQ(
        std::sscanf(line.c_str(), "%lf degrees, between %lf and %lf", &value, &before, &after), 3)
        << line;
    EXPECT_LE(std::min(before, after), value) << line;
    EXPECT_GE(std::max(before, after), value) << line;
    EXPECT_NE(before, after) << line;
  }
}

TEST_P(Tutorial, ProgramsShareTheStreamWithEachApi) {
  const dssm::test::DaemonProcess daemon;
  expect_climate(lines_read(GetParam().first, daemon, GetParam().second, daemon));
}

TEST_P(Tutorial, ProgramsShareTheStreamBetweenTwoHosts) {
  const dssm::test::DaemonProcess pc1;
  const dssm::test::DaemonProcess pc2({"--peer", pc1.address()}, "pc2");
  expect_climate(lines_read(GetParam().first, pc2, GetParam().second, pc1));
}

INSTANTIATE_TEST_SUITE_P(AllPairs, Tutorial,
                         testing::Values(std::pair{"reader", "writer"},
                                         std::pair{"callback", "writer"},
                                         std::pair{"docs/examples/loops/poll_loop", "writer"},
                                         std::pair{"docs/examples/loops/libevent_loop", "writer"},
                                         std::pair{"ssm_reader", "ssm_writer"},
                                         std::pair{"reader", "ssm_writer"},
                                         std::pair{"ssm_reader", "writer"}));

}  // namespace
