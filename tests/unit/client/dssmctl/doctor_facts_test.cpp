// SPDX-License-Identifier: Apache-2.0
#include "client/dssmctl/doctor_facts.hpp"

#include <gtest/gtest.h>

namespace dssm::ctl {
namespace {

using State = ClockFacts::State;

std::string tracking(const std::string& leap) {
  return "C0A80001,ntp.pc2,3,1700000000.123,0.000001,0.000002,0.000003,-12.3,0.001,0.05,0.0002,"
         "0.0003,64.2," +
         leap + "\n";
}

TEST(ClockFacts, FollowFromWhatChronycTells) {
  for (const char* leap : {"Normal", "Insert second", "Delete second"}) {
    const ClockFacts facts = clock_facts_untrusted(0, tracking(leap));
    EXPECT_EQ(facts.state, State::synchronized) << leap;
    EXPECT_EQ(facts.detail, "ntp.pc2");
  }
  const ClockFacts facts = clock_facts_untrusted(0, tracking("Not synchronised"));
  EXPECT_EQ(facts.state, State::unsynchronized);
  EXPECT_EQ(facts.detail, "Not synchronised");
}

TEST(ClockFacts, AreNoneWhenChronycSaysSomethingElse) {
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

}  // namespace
}  // namespace dssm::ctl
