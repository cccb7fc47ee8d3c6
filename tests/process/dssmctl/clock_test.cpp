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
                                      "REFERENCE", "POLL", "AGE", "READS", "REASON"}));
  EXPECT_TRUE(contains(lines[1], "no chronyd")) << lines[1];
  EXPECT_EQ(words_of(lines[2]).back(), "good") << "and no reason against it";
}

TEST_F(Clock, HasNoMatrixWithoutAnotherHost) {
  for (DaemonProcess* daemon : {&pc2_, &pc3_}) daemon->kill_hard();
  for (const char* host : {"pc2", "pc3"}) await_state(host, HostState::down);
  const Finished finished = ctl({"clock", "--matrix"});
  EXPECT_EQ(finished.exit_status, 0);
  const std::vector<std::string> lines = lines_of(finished.out);
  ASSERT_EQ(lines.size(), 2U) << finished.out;
  EXPECT_EQ(lines[1], "no other host is up, so there is no pair; see `dssmctl hosts`");
}

TEST_F(Clock, IsWaitedForUntilReadsByTimeAcceptTheOthersSamples) {
  for (const char* host : {"pc2", "pc3"}) await_state(host, HostState::up);
  const Finished finished = ctl({"clock", "--wait", "60"});
  EXPECT_EQ(finished.exit_status, 0) << "without a chronyd, by what was measured: " << finished.err;
}

TEST_F(Clock, IsWaitedForAndReportsWhyItFailed) {
  for (DaemonProcess* daemon : {&pc2_, &pc3_}) daemon->kill_hard();
  for (const char* host : {"pc2", "pc3"}) await_state(host, HostState::down);
  clocks();
  Running waiting({dssmctl_path(), "clock", "--wait", "1000"}, {daemon_.environment()});
  EXPECT_TRUE(
      waiting.line().starts_with("dssmctl: clock: waits up to 16m40s: no other host is up, and the "
                                 "clock of this host is unknown: no chronyd; see `chronyc"));
  waiting.signal(SIGINT);
  EXPECT_EQ(waiting.status(), 1);
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
  EXPECT_TRUE(table[0]["offset"]["average_ns"].is_null());
  EXPECT_TRUE(table[0]["bound"]["max_ns"].is_null());
}

TEST_F(Clock, IsRefreshedUntilItIsInterrupted) {
  Running watch({dssmctl_path(), "clock", "--watch", "--json"}, {daemon_.environment()});
  EXPECT_EQ(Json::parse(watch.line())["clocks"].size(), 3U);
  pc3_.kill_hard();
  while (Json::parse(watch.line())["clocks"].size() != 2) {
  }
  watch.signal(SIGINT);
  EXPECT_EQ(watch.status(), 0);
}

// pc1 knows pc2 and pc3, which know no other host.
TEST_F(Clock, MatrixHasARowForEachPairOfHosts) {
  const Json pairs = json({"clock", "--matrix"})["clock_pairs"];
  std::string shown;
  for (const Json& pair : pairs) {
    shown += pair["reader"].get<std::string>() + pair["owner"].get<std::string>() + " ";
  }
  EXPECT_EQ(shown, "pc1pc2 pc1pc3 pc2pc1 pc2pc3 pc3pc1 pc3pc2 ");
  EXPECT_EQ(pairs.at(0), Json({{"reader", "pc1"},
                               {"owner", "pc2"},
                               {"reads", "good"},
                               {"reads_reason", nullptr},
                               {"bound_ns", 0},
                               {"limit_ns", 1'500'000},
                               {"known_by", "one clock"},
                               {"chain_ns", nullptr},
                               {"measured_ns", nullptr},
                               {"round_trip_ns", nullptr},
                               {"error", nullptr}}));
  EXPECT_TRUE(pairs.at(2)["reads"].is_null());
  EXPECT_TRUE(pairs.at(2)["bound_ns"].is_null());
  EXPECT_TRUE(pairs.at(2)["limit_ns"].is_null());
  EXPECT_TRUE(contains(pairs.at(2)["error"], "'pc2' has no connection to 'pc1'"));

  const std::vector<std::string> lines = lines_of(output({"clock", "--matrix"}));
  ASSERT_EQ(lines.size(), 7U);
  EXPECT_EQ(words_of(lines[0]),
            (std::vector<std::string>{"ON", "OF", "READS", "BOUND", "OF", "LIMIT", "LIMIT", "KNOWN",
                                      "BY", "CHAIN", "MEASURED", "RTT", "REASON"}));
  EXPECT_EQ(words_of(lines[1]),
            (std::vector<std::string>{"pc1", "pc2", "good", "0", "ns", "[", "]", "1.50", "ms",
                                      "one", "clock", "-", "-", "-"}));
  EXPECT_TRUE(contains(lines[6], "'pc3' has no connection to 'pc2'")) << lines[6];
}

TEST_F(Clock, MatrixHasWhatOtherHostsStateOfHostsThatAreNotKnownHere) {
  const DaemonProcess pc4({"--peer", daemon_.address(), "--clock-limit", "2 ms"}, "pc4");
  Session on_pc4 = session_with(pc4);
  await([&] { return on_pc4.list_hosts().value().at(1).state == HostState::up; });
  const std::vector<ClockPair> pairs = on_pc4.list_clock_pairs().value();
  ASSERT_EQ(pairs.size(), 4U);
  EXPECT_EQ(pairs[0].reader + pairs[0].owner, "pc1pc2");
  EXPECT_EQ(pairs[0].basis, DistanceBasis::one_clock);
  EXPECT_EQ(pairs[0].bound, Duration::zero());
  EXPECT_EQ(pairs[0].limit, std::chrono::microseconds(1500)) << "pc1's";
  EXPECT_EQ(pairs[1].reader + pairs[1].owner, "pc1pc3");
  EXPECT_EQ(pairs[2].reader + pairs[2].owner, "pc1pc4");
  EXPECT_NE(pairs[2].error, "");
  EXPECT_EQ(pairs[2].bound, kUnknownClockError);
  EXPECT_EQ(pairs[3].reader + pairs[3].owner, "pc4pc1");
  EXPECT_EQ(pairs[3].limit, std::chrono::milliseconds(2)) << "its own";
}

TEST_F(Clock, MatrixIsRefreshedUntilItIsInterrupted) {
  Running watch({dssmctl_path(), "clock", "--matrix", "--watch", "--json"},
                {daemon_.environment()});
  while (Json::parse(watch.line())["clock_pairs"].size() != 6) {
  }
  pc3_.kill_hard();
  while (Json::parse(watch.line())["clock_pairs"].size() != 2) {
  }
  watch.signal(SIGINT);
  EXPECT_EQ(watch.status(), 0);
}

TEST_F(Clock, MatrixGoesWithNeitherTableNorWait) {
  EXPECT_EQ(ctl({"clock", "--matrix", "--table", "2"}).exit_status, 2);
  EXPECT_EQ(ctl({"clock", "--matrix", "--wait", "1"}).exit_status, 2);
}

}  // namespace
}  // namespace dssm::test
