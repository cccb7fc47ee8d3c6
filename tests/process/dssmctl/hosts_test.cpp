// SPDX-License-Identifier: Apache-2.0
//
// dssmctl hosts and ping.
#include <signal.h>

#include "tests/process/dssmctl/fleet_test.hpp"

namespace dssm::test {
namespace {

using Hosts = FleetTest;
using Ping = FleetTest;
using Strings = std::vector<std::string>;

TEST_F(Hosts, ShowsThisHostFirstAndHowTheOthersAreReached) {
  auto writer = on_pc2_.create<double>("lidar", depth_of(4)).value();
  await_streams(1);
  const Json hosts = json({"hosts"})["hosts"];
  ASSERT_EQ(hosts.size(), 3U);
  EXPECT_EQ(hosts[0]["host"], "pc1");
  EXPECT_EQ(hosts[0]["state"], "self");
  EXPECT_EQ(hosts[0]["addresses"], Json({daemon_.address()}));
  EXPECT_TRUE(hosts[0]["round_trip_ns"].is_null());
  EXPECT_EQ(hosts[1]["host"], "pc2");
  EXPECT_EQ(hosts[1]["state"], "up");
  EXPECT_EQ(hosts[1]["addresses"], Json({pc2_.address()}));
  EXPECT_EQ(hosts[1]["streams"], 1);
  EXPECT_EQ(hosts[1]["found_by"], host("pc2").found_by);
  EXPECT_EQ(hosts[1]["id"].get<std::string>().size(), 32U);
  EXPECT_NE(hosts[1]["id"], hosts[0]["id"]);
  EXPECT_EQ(hosts[1]["version"], hosts[0]["version"]);
  EXPECT_GE(hosts[1]["state_for_ns"], 0);
  EXPECT_EQ(hosts[1]["insecure"], false);  // loopback
  EXPECT_TRUE(hosts[1]["clock_bound_ns"].is_null());
  EXPECT_TRUE(hosts[1]["error"].is_null());

  const Strings lines = lines_of(output({"hosts"}));
  ASSERT_EQ(lines.size(), 4U);
  EXPECT_EQ(words_of(lines[0]), (Strings{"HOST", "STATE", "ADDRESS", "FOUND", "BY", "VERSION",
                                         "RTT", "STREAMS", "CLOCK", "NOTE"}));
  EXPECT_EQ(words_of(lines[1]),
            (Strings{"pc1", "self", daemon_.address(), "-", DSSM_VERSION, "-", "0", "unknown"}));
  EXPECT_TRUE(lines[2].starts_with("pc2   up     " + pc2_.address())) << lines[2];
}

TEST_F(Hosts, SucceedsAndReportsWhyAHostIsDown) {
  pc3_.kill_hard();
  await_state("pc3", HostState::down);
  const std::string row = lines_of(output({"hosts"}))[3];
  EXPECT_TRUE(row.starts_with("pc3   down")) << row;
  const Json down = json({"hosts"})["hosts"][2];
  EXPECT_EQ(down["state"], "down");
  // The reason is another one from attempt to attempt, and always names who is meant.
  const std::string who = "'" + pc3_.address() + "'";
  EXPECT_TRUE(contains(row, who)) << row;
  EXPECT_TRUE(contains(down["error"].get<std::string>(), who)) << down;
  EXPECT_EQ(json({"ls"})["streams"].size(), 0U);
}

TEST_F(Hosts, GivesEachNameOnceToPrograms) {
  EXPECT_EQ(output({"hosts", "--names"}), "pc1\npc2\npc3\n");
  const std::string closed = pc3_.address();
  pc3_.kill_hard();
  const std::string other_address = "localhost" + pc2_.address().substr(pc2_.address().find(':'));
  DaemonProcess pc4({"--peer", pc2_.address(), "--peer", closed, "--peer", other_address}, "pc4");
  Session session = session_with(pc4);
  const auto state = [&](std::size_t i) { return session.list_hosts().value()[i].state; };
  await([&] {
    return state(1) == HostState::up && state(2) == HostState::down && state(3) == HostState::up;
  });
  EXPECT_EQ(output({"--socket", pc4.socket_path(), "hosts", "--names"}), "pc4\npc2\n");
  const Json hosts = json({"--socket", pc4.socket_path(), "hosts"})["hosts"];
  ASSERT_EQ(hosts.size(), 4U);
  EXPECT_TRUE(hosts[2]["host"].is_null());
  EXPECT_EQ(hosts[2]["addresses"][0], closed);
  // Whichever came first is in use.
  const Json& spare = hosts[1]["error"].is_null() ? hosts[3] : hosts[1];
  EXPECT_TRUE(contains(spare["error"].get<std::string>(), "same host as")) << hosts;
}

TEST_F(Ping, PrintsEachAnswerAndAllTimes) {
  const Strings lines = lines_of(output({"ping", "pc2", "-c", "3", "-i", "0.01"}));
  ASSERT_EQ(lines.size(), 5U);
  for (std::size_t i = 0; i < 3; ++i) {
    EXPECT_TRUE(lines[i].starts_with("answer from pc2 (" + pc2_.address() +
                                     "): seq=" + std::to_string(i + 1) + " time="))
        << lines[i];
  }
  EXPECT_EQ(lines[3], "--- pc2: asked 3, answered 3 ---");
  EXPECT_TRUE(lines[4].starts_with("round trip min/avg/max/mdev: ")) << lines[4];
}

TEST_F(Ping, PrintsTheSameAsJson) {
  const Strings lines = lines_of(output({"ping", "pc2", "-c", "2", "-i", "0.01", "--json"}));
  ASSERT_EQ(lines.size(), 3U);
  const Json first = Json::parse(lines[0]), second = Json::parse(lines[1]);
  const Json summary = Json::parse(lines[2]);
  EXPECT_EQ(first["host"], "pc2");
  EXPECT_EQ(first["seq"], 1);
  EXPECT_EQ(first["address"], pc2_.address());
  EXPECT_EQ(summary["asked"], 2);
  EXPECT_EQ(summary["answered"], 2);
  const auto least = std::min(first["round_trip_ns"].get<std::int64_t>(),
                              second["round_trip_ns"].get<std::int64_t>());
  EXPECT_GT(least, 0);
  EXPECT_EQ(summary["round_trip_min_ns"], least);
  EXPECT_GE(summary["round_trip_max_ns"].get<std::int64_t>(), least);
  EXPECT_GE(summary["round_trip_mean_ns"].get<double>(), static_cast<double>(least));
}

TEST_F(Ping, EndsWithItsSummaryOnASignal) {
  Running ping(argv({"ping", "pc2", "-i", "1000"}), environment());
  EXPECT_TRUE(ping.line().starts_with("answer from pc2"));
  ping.signal(SIGINT);
  EXPECT_EQ(ping.line(), "--- pc2: asked 1, answered 1 ---");
  ping.rest();
  EXPECT_EQ(ping.status(), 0);
}

TEST_F(Ping, EndsWithoutWaitingForAnAnswer) {
  ::kill(pc2_.pid(), SIGSTOP);
  Running ping(argv({"ping", "pc2"}), environment());
  await([&] { return session_.list_clients().value().size() == 2; });
  ping.signal(SIGINT);
  std::string line;
  do line = ping.line();
  while (line.starts_with("no answer: "));  // it has begun so late that pc2 was down
  EXPECT_TRUE(line.starts_with("--- pc2: asked ") && line.ends_with(", answered 0 ---")) << line;
  ping.rest();
  EXPECT_EQ(ping.status(), 1);
  ::kill(pc2_.pid(), SIGCONT);
}

TEST_F(Ping, EndsQuietlyWhenItsReaderHasEnough) {
  Running ping(argv({"ping", "pc2", "-i", "1000"}), environment());
  ping.line();
  ping.close_output();
  EXPECT_EQ(ping.status(), 0);
}

TEST_F(Ping, FailsWhenNothingAnswered) {
  pc3_.kill_hard();
  await_state("pc3", HostState::down);
  const Finished finished = ctl({"ping", "pc3", "-c", "2", "-i", "0.01"});
  EXPECT_EQ(finished.exit_status, 1);
  const Strings lines = lines_of(finished.out);
  ASSERT_EQ(lines.size(), 3U) << finished.out;
  EXPECT_TRUE(lines[0].starts_with("no answer: seq=1: ")) << lines[0];
  EXPECT_EQ(lines[2], "--- pc3: asked 2, answered 0 ---");
  EXPECT_TRUE(contains(finished.err, "'pc3' did not answer")) << finished.err;
}

TEST_F(Ping, ContinuesWhileTheHostIsDownAndAfterwards) {
  Running ping(argv({"ping", "pc3", "-i", "0.01"}), environment());
  EXPECT_TRUE(ping.line().starts_with("answer from pc3"));
  pc3_.kill_hard();
  while (!ping.line().starts_with("no answer: ")) {
  }
  pc3_.start();
  while (!ping.line().starts_with("answer from pc3")) {
  }
  ping.signal(SIGTERM);
  ping.rest();
  EXPECT_EQ(ping.status(), 0);
}

TEST_F(Ping, NamesTheHostsThereAreWhenOneIsUnknown) {
  const Finished finished = ctl({"ping", "pc9"});
  EXPECT_EQ(finished.exit_status, 1);
  EXPECT_EQ(finished.out, "");
  EXPECT_TRUE(contains(finished.err, "'pc9'") && contains(finished.err, "'pc2'")) << finished.err;
}

TEST_F(Ping, AnswersForThisHostAtOnce) {
  EXPECT_TRUE(output({"ping", "pc1", "-c", "1"}).starts_with("answer from pc1 (this PC): seq=1"));
}

TEST_F(Hosts, WatchPrintsThemAgainWhenTheyChange) {
  Running watch(argv({"hosts", "--watch", "--json"}), environment());
  const auto state_of_pc2 = [&] {
    const Json hosts = Json::parse(watch.line())["hosts"];
    for (const Json& host : hosts) {
      if (host["host"] == "pc2") return host["state"].get<std::string>();
    }
    return std::string("missing");
  };
  while (state_of_pc2() != "up") {
  }
  pc2_.kill_hard();
  while (state_of_pc2() != "down") {
  }
  watch.signal(SIGINT);
  watch.rest();
  EXPECT_EQ(watch.status(), 0);
}

}  // namespace
}  // namespace dssm::test
