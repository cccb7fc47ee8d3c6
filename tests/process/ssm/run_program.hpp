// SPDX-License-Identifier: Apache-2.0
//
// Tests that run one of programs/ each.
#pragma once

#include <gtest/gtest.h>

#include <algorithm>
#include <cctype>
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

}  // namespace dssm::test
