// SPDX-License-Identifier: Apache-2.0
//
// Running programs in tests: one of programs/ with all its checks, or any with pipes.
#pragma once

#include <fcntl.h>
#include <gtest/gtest.h>
#include <unistd.h>

#include <algorithm>
#include <cctype>
#include <cstdlib>
#include <string>
#include <vector>

#include "tests/support/daemon_process.hpp"

namespace dssm::test {

// The program's name, as GoogleTest allows it.
inline std::string test_name(const testing::TestParamInfo<std::string>& info) {
  std::string name = info.param;
  std::replace_if(
      name.begin(), name.end(), [](unsigned char c) { return !std::isalnum(c); }, '_');
  return name;
}

// Runs a program with a dssmd of its own; all its checks must hold.
//   passes_address  whether its arguments are FOLDER ADDRESS, or just FOLDER
inline void expect_checks_hold(const std::string& program, bool passes_address) {
  const DaemonProcess daemon({"--log-level", "warning"});
  const std::string folder = make_temp_dir();
  std::vector<std::string> argv = {built("tests/process/ssm/" + program), folder};
  if (passes_address) argv.push_back(daemon.address());
  const Finished finished = run(argv, {daemon.environment()});
  EXPECT_EQ(finished.exit_status, 0) << finished.out << finished.err;
  remove_tree(folder);
}

// A program whose standard input and output are the test's.
class PipedProgram {
 public:
  //   with_errors  its standard error, too
  PipedProgram(const std::vector<std::string>& argv, const std::string& environment,
               bool with_errors = false) {
    int in[2], out[2];
    if (::pipe2(in, O_CLOEXEC) || ::pipe2(out, O_CLOEXEC)) std::abort();
    // start() leaves stdin alone: the shell takes it from the pipe's path in /proc.
    const std::string path = "/proc/" + std::to_string(::getpid()) + "/fd/" + std::to_string(in[0]);
    std::string command = "exec";
    for (const std::string& word : argv) command += " '" + word + "'";
    if (with_errors) command += " 2>&1";
    pid_ = start({"sh", "-c", command + " <" + path}, {environment}, out[1]);
    ::close(out[1]);
    read_in_ = in[0];
    to_ = in[1];
    from_ = out[0];
  }
  PipedProgram(const PipedProgram&) = delete;
  PipedProgram& operator=(const PipedProgram&) = delete;

  pid_t pid() const { return pid_; }

  void write_line(const std::string& line) const {
    ASSERT_EQ(::write(to_, line.data(), line.size()), static_cast<ssize_t>(line.size()));
  }
  std::string line() const {
    std::string text;
    for (char c = 0; ::read(from_, &c, 1) == 1 && c != '\n';) text += c;
    return text;
  }
  // Its exit status, and what else it said.
  int end(std::string& rest) {
    ::close(to_);
    ::close(read_in_);
    char buffer[4096];
    for (ssize_t n; (n = ::read(from_, buffer, sizeof buffer)) > 0;) {
      rest.append(buffer, static_cast<std::size_t>(n));
    }
    ::close(from_);
    return wait_for(pid_);
  }

 private:
  pid_t pid_ = -1;
  int read_in_ = -1, to_ = -1, from_ = -1;
};

}  // namespace dssm::test
