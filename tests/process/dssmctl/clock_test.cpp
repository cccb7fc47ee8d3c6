// SPDX-License-Identifier: Apache-2.0
//
// dssmctl clock, where there is no chronyd; with real ones it is shown by tests/fleet.
#include "tests/process/dssmctl/fleet_test.hpp"

namespace dssm::test {
namespace {

class Clock : public FleetTest {
 protected:
  // Until dssmd has asked for chronyd.
  Json clocks() {
    for (;;) {
      Json clocks = json({"clock"})["clocks"];
      const bool all = std::none_of(clocks.begin(), clocks.end(), [](const Json& clock) {
        return clock["status"] == "unknown" && clock["reason"].is_null();
      });
      if (all) return clocks;
    }
  }
};

TEST_F(Clock, HasARowForEachHostThatIsThere) {
  pc3_.kill_hard();
  await_state("pc3", HostState::down);
  const Json shown = clocks();
  ASSERT_EQ(shown.size(), 2U);
  EXPECT_EQ(shown[0]["host"], "pc1");
  EXPECT_EQ(shown[0]["state"], "self");
  EXPECT_EQ(shown[0]["reason"], "no chronyd");
  EXPECT_TRUE(shown[0]["bound_ns"].is_null());
  EXPECT_TRUE(shown[0]["reference"].is_null());
  EXPECT_EQ(shown[1]["host"], "pc2");
  EXPECT_TRUE(shown[0]["reads"].is_null());
  EXPECT_EQ(shown[1]["distance_ns"], 0) << "both have this kernel's clock";
  EXPECT_EQ(shown[1]["reads"], "good");
  EXPECT_TRUE(shown[1]["reads_reason"].is_null());

  const std::vector<std::string> lines = lines_of(output({"clock"}));
  ASSERT_EQ(lines.size(), 3U);
  EXPECT_EQ(words_of(lines[0]),
            (std::vector<std::string>{"HOST", "STATUS", "BOUND", "FROM", "HERE", "OFFSET",
                                      "REFERENCE", "POLL", "AGE", "READS"}));
  EXPECT_TRUE(contains(lines[1], "no chronyd")) << lines[1];
}

TEST_F(Clock, IsWaitedForAndReportsWhyItFailed) {
  clocks();
  const Finished finished = ctl({"clock", "--wait", "0"});
  EXPECT_EQ(finished.exit_status, 1);
  EXPECT_EQ(finished.out, "");
  EXPECT_TRUE(contains(finished.err, "no chronyd")) << finished.err;
  EXPECT_TRUE(contains(finished.err, "chronyc tracking")) << finished.err;
}

TEST_F(Clock, IsTabulatedWithHowOftenItWasNotKnown) {
  const Json table = json({"clock", "--table", "2"})["clocks"];
  ASSERT_EQ(table.size(), 3U);
  EXPECT_EQ(table[0]["host"], "pc1");
  EXPECT_EQ(table[0]["offset"]["readings"], 0);
  EXPECT_EQ(table[0]["unknown"], 2);
}

TEST_F(Clock, IsRefreshedUntilItIsInterrupted) {
  Running watch({dssmctl_path(), "clock", "--watch", "--json"}, {daemon_.environment()});
  for (int i = 0; i < 2; ++i) EXPECT_EQ(Json::parse(watch.line())["clocks"].size(), 3U);
  watch.signal(SIGINT);
  EXPECT_EQ(watch.status(), 0);
}

}  // namespace
}  // namespace dssm::test
