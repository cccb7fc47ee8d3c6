// SPDX-License-Identifier: Apache-2.0
#include "client/dssmctl/program.hpp"

#include <gtest/gtest.h>

namespace dssm::ctl {
namespace {

using namespace std::chrono_literals;

constexpr Duration kAmple = 1h;  // for programs that are to end by themselves

TEST(RunProgram, GivesOutputsAndExitStatus) {
  const auto end = run_program({"sh", "-c", "echo out; echo err >&2; exit 3"}, kAmple);
  ASSERT_TRUE(end);
  EXPECT_TRUE(end->in_time);
  EXPECT_EQ(end->exit_status, 3);
  EXPECT_EQ(end->output, "out\nerr\n");
}

TEST(RunProgram, WaitsForTheStatusOfAProgramThatClosedItsOutputs) {
  const auto end = run_program({"sh", "-c", "exec >&- 2>&-; sleep 0.1; exit 4"}, kAmple);
  ASSERT_TRUE(end);
  EXPECT_EQ(end->exit_status, 4);
}

TEST(RunProgram, SaysWhenThereIsNoSuchProgram) {
  EXPECT_FALSE(run_program({"a-program-that-nobody-has"}, kAmple));
}

TEST(RunProgram, KillsAProgramThatDoesNotEnd) {
  const auto end = run_program({"sh", "-c", "echo began; exec sleep 1000"}, 100ms);
  ASSERT_TRUE(end);
  EXPECT_FALSE(end->in_time);
  EXPECT_EQ(end->exit_status, -1);
}

TEST(RunProgram, GivesNoInputAndKeepsOnlySoMuchOutput) {
  const auto end = run_program({"sh", "-c", "cat; head -c 1000000 /dev/zero"}, kAmple);
  ASSERT_TRUE(end);
  EXPECT_EQ(end->exit_status, 0);
  EXPECT_EQ(end->output.size(), kMaxProgramOutput);
}

}  // namespace
}  // namespace dssm::ctl
