// SPDX-License-Identifier: Apache-2.0
#include <gtest/gtest.h>

#include <cstdlib>

#include "tests/support/daemon_process.hpp"

namespace dssm::test {
namespace {

constexpr int kNoLibrary = 77;  // the script's status

// Debian's own Python, for which python3-protobuf is installed, whatever else is in $PATH.
constexpr const char* kPython = "/usr/bin/python3";

TEST(StockProtobuf, IsEnoughToSpeakToDssmd) {
  const DaemonProcess dssmd;
  const std::string root = std::getenv("DSSM_SOURCE_ROOT");
  const Finished finished = run({kPython, root + "/tests/process/channel/stock_protobuf.py",
                                 dssmd.address(), root + "/proto"});
  if (finished.exit_status == kNoLibrary) {
    GTEST_SKIP() << "needs protobuf's Python library (python3-protobuf)";
  }
  EXPECT_EQ(finished.exit_status, 0) << finished.out << finished.err;
}

}  // namespace
}  // namespace dssm::test
