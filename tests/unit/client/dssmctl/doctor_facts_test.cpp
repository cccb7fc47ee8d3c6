// SPDX-License-Identifier: Apache-2.0
#include <gtest/gtest.h>

#include "client/dssmctl/doctor.hpp"

namespace dssm::ctl {
namespace {

using State = ClockFacts::State;

std::string tracking(const std::string& leap) {
  return "C0A80001,ntp.pc2,3,1700000000.123,0.000001,0.000002,0.000003,-12.3,0.001,0.05,0.0002,"
         "0.0003,64.2," +
         leap + "\n";
}

TEST(ClockFacts, FollowFromWhatChronycPrints) {
  for (const char* leap : {"Normal", "Insert second", "Delete second"}) {
    const ClockFacts facts = clock_facts_untrusted(0, tracking(leap));
    EXPECT_EQ(facts.state, State::synchronized) << leap;
    EXPECT_EQ(facts.detail, "ntp.pc2");
  }
  const ClockFacts facts = clock_facts_untrusted(0, tracking("Not synchronised"));
  EXPECT_EQ(facts.state, State::unsynchronized);
  EXPECT_EQ(facts.detail, "Not synchronised");
}

TEST(ClockFacts, AreNoneWhenChronycPrintsSomethingElse) {
  const ClockFacts facts = clock_facts_untrusted(1, "506 Cannot talk to daemon\n");
  EXPECT_EQ(facts.state, State::no_answer);
  EXPECT_EQ(facts.detail, "506 Cannot talk to daemon");
  for (const std::string& output :
       {std::string(), std::string("\n"), std::string(",,,,"), tracking("Normal").substr(10),
        tracking("Normal,more"), std::string(100'000, ','), std::string(100'000, 'x')}) {
    const ClockFacts strange = clock_facts_untrusted(0, output);
    EXPECT_EQ(strange.state, State::no_answer) << output.substr(0, 100);
    EXPECT_LE(strange.detail.size(), 200U);
  }
  EXPECT_EQ(clock_facts_untrusted(1, tracking("Normal")).state, State::no_answer);
}

TEST(SoftLimit, IsTheFirstNumberOfItsLine) {
  EXPECT_EQ(
      soft_limit_untrusted("Limit                     Soft Limit           Hard Limit\n"
                           "Max processes             7                    8\n"
                           "Max open files            1024                 524288     files\n"),
      1024U);
  for (const char* text : {"", "Max open files", "Max open files unlimited unlimited files"}) {
    EXPECT_EQ(soft_limit_untrusted(text), 0U) << text;
  }
}

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

TEST(RunProgram, ReportsThatThereIsNoSuchProgram) {
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
