// SPDX-License-Identifier: Apache-2.0
//
// The programs of docs/tutorial.md, built from its very text, talk to each other.
#include <fcntl.h>
#include <gtest/gtest.h>
#include <signal.h>
#include <unistd.h>

#include <cstdio>
#include <cstdlib>
#include <regex>
#include <string>
#include <vector>

#include "tests/support/daemon_process.hpp"

namespace {

std::string program(const std::string& name) {
  return dssm::test::built("tests/process/vehicle/tutorial_" + name);
}

// Starts both, the reader first, each with its dssmd, and gives the first lines that the reader
// prints; none when it ends early.
std::vector<std::string> lines_read(const std::string& reader,
                                    const dssm::test::DaemonProcess& readers_daemon,
                                    const std::string& writer,
                                    const dssm::test::DaemonProcess& writers_daemon) {
  constexpr std::size_t kEnough = 4;
  // A terminal of the test's own: into a pipe the reader would write only when a buffer is full.
  const int terminal = ::posix_openpt(O_RDWR | O_NOCTTY | O_CLOEXEC);
  EXPECT_EQ(::grantpt(terminal), 0);
  EXPECT_EQ(::unlockpt(terminal), 0);
  const int its_end = ::open(::ptsname(terminal), O_RDWR | O_NOCTTY | O_CLOEXEC);
  const pid_t reading =
      dssm::test::start({program(reader)}, {readers_daemon.environment()}, its_end);
  ::close(its_end);
  const pid_t writing = dssm::test::start({program(writer)}, {writers_daemon.environment()});
  std::vector<std::string> lines;
  std::FILE* output = ::fdopen(terminal, "r");
  char line[256];
  while (lines.size() < kEnough && std::fgets(line, sizeof line, output)) lines.push_back(line);
  std::fclose(output);
  for (const pid_t pid : {reading, writing}) {
    ::kill(pid, SIGTERM);
    dssm::test::wait_for(pid);
  }
  return lines;
}

class Tutorial : public testing::TestWithParam<std::pair<const char*, const char*>> {};

void expect_climate(const std::vector<std::string>& lines) {
  ASSERT_EQ(lines.size(), 4u);
  const std::regex expected(R"(\d+: (19|20|21)\.\d\d degrees, [+-]0\.\d\d in a second\r\n)");
  for (const std::string& line : lines) EXPECT_TRUE(std::regex_match(line, expected)) << line;
}

TEST_P(Tutorial, ProgramsShareTheStreamWhicheverApiTheyUse) {
  const dssm::test::DaemonProcess daemon;
  expect_climate(lines_read(GetParam().first, daemon, GetParam().second, daemon));
}

TEST_P(Tutorial, ProgramsShareTheStreamFromTwoHosts) {
  const dssm::test::DaemonProcess pc1;
  const dssm::test::DaemonProcess pc2({"--peer", pc1.address()}, "pc2");
  expect_climate(lines_read(GetParam().first, pc2, GetParam().second, pc1));
}

INSTANTIATE_TEST_SUITE_P(AllPairs, Tutorial,
                         testing::Values(std::pair{"reader", "writer"},
                                         std::pair{"ssm_reader", "ssm_writer"},
                                         std::pair{"reader", "ssm_writer"},
                                         std::pair{"ssm_reader", "writer"}));

}  // namespace
