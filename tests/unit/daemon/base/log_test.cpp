// SPDX-License-Identifier: Apache-2.0
#include "daemon/base/log.hpp"

#include <gtest/gtest.h>

namespace dssm::daemon {
namespace {

std::string logged(LogLevel level, bool journal_prefix, LogLevel of, std::string_view text,
                   const LogFields& fields = {}) {
  testing::internal::CaptureStderr();
  StderrLogger logger(level, journal_prefix);
  logger.write(of, text, fields);
  return testing::internal::GetCapturedStderr();
}

TEST(StderrLogger, WritesOneLineWithItsLevel) {
  EXPECT_EQ(logged(LogLevel::info, false, LogLevel::warning, "hot"), "dssmd: warning: hot\n");
  EXPECT_EQ(logged(LogLevel::info, false, LogLevel::info, "calm"), "dssmd: calm\n");
}

TEST(StderrLogger, WritesThePrefixThatJournaldReads) {
  EXPECT_EQ(logged(LogLevel::info, true, LogLevel::error, "hot"), "<3>hot\n");
}

TEST(StderrLogger, LeavesOutWhatIsBelowItsLevel) {
  EXPECT_EQ(logged(LogLevel::warning, false, LogLevel::notice, "calm"), "");
}

TEST(StderrLogger, NamesThePeerAndDoesNotLetItForgeLines) {
  EXPECT_EQ(logged(LogLevel::info, false, LogLevel::info, "came", {.peer = "x\ndssmd: y"}),
            "dssmd: came [peer x?dssmd: y]\n");
}

}  // namespace
}  // namespace dssm::daemon
