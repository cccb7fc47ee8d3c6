// SPDX-License-Identifier: Apache-2.0
//
// Runs the programs of programs/, which are written as old SSM programs are and use only what the
// original headers offer, each in all its dialects against a dssmd of its own.
#include <fcntl.h>
#include <gtest/gtest.h>
#include <unistd.h>

#include <algorithm>
#include <cstdlib>
#include <dssm/dssm.hpp>
#include <fstream>

#include "tests/process/ssm/run_program.hpp"
#include "tests/support/daemon_process.hpp"

namespace dssm::test {
namespace {

class SsmProgram : public testing::TestWithParam<std::string> {};

TEST_P(SsmProgram, ChecksHold) { expect_checks_hold(GetParam(), false); }

class SsmProcesses : public testing::TestWithParam<std::string> {};

TEST_P(SsmProcesses, ChecksHold) {
  if (kIsSanitized && GetParam().ends_with("c++20")) {
    GTEST_SKIP() << "the same program is tested in another dialect";
  }
  expect_checks_hold(GetParam(), false);
}

INSTANTIATE_TEST_SUITE_P(C, SsmProgram,
                         testing::Values("c_streams-c99", "c_streams-gnu89", "c_samples-c99",
                                         "c_samples-gnu89", "c_time-c99", "c_time-gnu89"),
                         test_name);
INSTANTIATE_TEST_SUITE_P(Cpp, SsmProgram,
                         testing::Values("cpp_api-gnu++98", "cpp_api-c++11", "cpp_api-c++14",
                                         "cpp_api-c++17", "cpp_api-c++20", "cpp_traps-gnu++98",
                                         "cpp_traps-c++11", "cpp_traps-c++14", "cpp_traps-c++17",
                                         "cpp_traps-c++20", "cpp_threads-gnu++98",
                                         "cpp_log-gnu++98", "cpp_log-c++11", "cpp_log-c++14",
                                         "cpp_log-c++17", "cpp_log-c++20"),
                         test_name);
INSTANTIATE_TEST_SUITE_P(Cpp, SsmProcesses,
                         testing::Values("cpp_signals-gnu++98", "cpp_signals-c++20",
                                         "cpp_processes-gnu++98", "cpp_processes-c++20"),
                         test_name);

TEST(SsmProgramThatEnds, CountsAsCrashedOnlyIfItHasNotClosedItsStream) {
  const DaemonProcess daemon;
  Session session = Session::connect({.socket_path = daemon.socket_path()}).value();
  for (int i = 0; i < 20; ++i) {
    const Finished finished =
        run({built("tests/process/ssm/cpp_ended-gnu++98")}, {daemon.environment()});
    ASSERT_EQ(finished.exit_status, 0) << finished.out << finished.err;
  }
  StreamInfo info;
  await([&] {
    info = session.stream_info({"ended", 0, ""}).value();
    return info.writers == 0;
  });
  EXPECT_EQ(info.crashed_writers, 0u) << info.last_crashed_writer;
}

TEST(SsmProgramAcrossRestart, LosesNoSampleWhenDssmdIsKilledAndRestarted) {
  DaemonProcess daemon({"--log-level", "warning"});
  const std::string folder = make_temp_dir();
  int out[2];
  ASSERT_EQ(::pipe2(out, O_CLOEXEC), 0);
  const pid_t program = start({built("tests/process/ssm/cpp_restart-gnu++98"), folder},
                              {daemon.environment()}, out[1]);
  ::close(out[1]);
  char running = 0;
  ASSERT_EQ(::read(out[0], &running, 1), 1);  // "running"
  for (int i = 0; i < 3; ++i) {
    daemon.kill_hard();
    daemon.start();
  }
  std::ofstream(folder + "/stop").close();
  std::string text;
  char buffer[4096];
  for (ssize_t n; (n = ::read(out[0], buffer, sizeof buffer)) > 0;) {
    text.append(buffer, static_cast<std::size_t>(n));
  }
  ::close(out[0]);
  EXPECT_EQ(wait_for(program), 0) << text;
  remove_tree(folder);
}

}  // namespace
}  // namespace dssm::test
