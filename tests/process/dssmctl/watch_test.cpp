// SPDX-License-Identifier: Apache-2.0
//
// dssmctl ls in a fleet: which streams it shows, and how it follows them.
#include <signal.h>

#include <set>

#include "tests/process/dssmctl/fleet_test.hpp"

namespace dssm::test {
namespace {

using LsInAFleet = FleetTest;
using LsWatch = CtlTest;
using Strings = std::vector<std::string>;

// Name, id and host of a row.
Strings first_three(const std::string& line) {
  Strings words = words_of(line);
  words.resize(3);
  return words;
}

TEST_F(LsInAFleet, ShowsTheStreamsOfTheGivenHostsOnly) {
  auto own = session_.create<double>("a", depth_of(4)).value();
  auto on_2 = on_pc2_.create<double>("b", depth_of(4)).value();
  auto on_3 = on_pc3_.create<double>("c", depth_of(4)).value();
  await_streams(2);
  EXPECT_EQ(output({"ls", "--names", "--host", "pc3"}), "c\n");
  EXPECT_EQ(output({"ls", "--names", "--host", "pc3", "--host", "pc1"}), "a\nc\n");
  EXPECT_EQ(output({"ls", "--names", "--local"}), "a\n");
  const Finished unknown = ctl({"ls", "--host", "pc9"});
  EXPECT_EQ(unknown.exit_status, 1);
  EXPECT_EQ(unknown.out, "");
  EXPECT_TRUE(contains(unknown.err, "host 'pc9'")) << unknown.err;
  EXPECT_TRUE(contains(unknown.err, "known are 'pc1', 'pc2', 'pc3'")) << unknown.err;
}

TEST_F(LsInAFleet, MarksStreamsThatSeveralHostsHave) {
  auto own = session_.create<double>("odom", depth_of(4)).value();
  auto alone = session_.create<double>("imu", depth_of(4)).value();
  auto on_2 = on_pc2_.create<double>("odom", depth_of(4)).value();
  await_streams(1);
  const Strings lines = lines_of(output({"ls"}));
  ASSERT_EQ(lines.size(), 5U);
  EXPECT_EQ(first_three(lines[1]), (Strings{"odom", "*", "0"}));
  EXPECT_EQ(first_three(lines[2]), (Strings{"imu", "0", "pc1"}));
  EXPECT_EQ(first_three(lines[3]), (Strings{"odom", "*", "0"}));
  EXPECT_TRUE(lines[4].starts_with("* ") && contains(lines[4], "odom:0@pc2")) << lines[4];
  const Json streams = json({"ls"})["streams"];
  EXPECT_EQ(streams[0]["duplicate"], true);
  EXPECT_EQ(streams[1]["duplicate"], false);
  EXPECT_EQ(streams[2]["duplicate"], true);
  // What is not shown makes a duplicate too.
  EXPECT_EQ(json({"ls", "--host", "pc2"})["streams"][0]["duplicate"], true);
  EXPECT_TRUE(json({"ls", "--own"})["streams"][0]["duplicate"].is_null());
  EXPECT_EQ(output({"ls", "--names", "--host", "pc2"}), "odom@pc2\n");
}

TEST_F(LsInAFleet, WatchShowsOtherHostsToo) {
  Running watch(argv({"ls", "--watch", "--host", "pc2"}), environment());
  auto on_3 = on_pc3_.create<double>("c", depth_of(4)).value();
  auto on_2 = on_pc2_.create<double>("b", depth_of(4)).value();
  EXPECT_TRUE(watch.line().starts_with("+ b:0@pc2 8 bytes, depth 4, "));
  pc2_.kill_hard();
  EXPECT_EQ(watch.line(), "- b:0@pc2");
}

TEST_F(LsWatch, ShowsOnlyWhatFitsThePattern) {
  for (const char* name : {"camera_left", "camera_right:2", "lidar"}) {
    output({"create", name, "--size", "4", "--depth", "4"});
  }
  EXPECT_EQ(output({"ls", "--names", "camera*"}), "camera_left\ncamera_right:2\n");
  EXPECT_EQ(output({"ls", "--names", "*:2"}), "camera_right:2\n");
  EXPECT_EQ(lines_of(ctl({"ls", "nothing*"}).out).size(), 1U);
  EXPECT_EQ(json({"ls", "nothing*"})["streams"].size(), 0U);
}

TEST_F(LsWatch, ShowsWhatIsThereAndThenEachChange) {
  output({"create", "first", "--size", "4", "--depth", "4", "--cycle", "0.01", "--type", "T"});
  Running watch(argv({"ls", "--watch"}), environment());
  EXPECT_EQ(watch.line(), "+ first:0@pc1 4 bytes, depth 4, cycle 10.0 ms, T");
  output({"create", "second:1", "--size", "4", "--depth", "4"});
  EXPECT_TRUE(watch.line().starts_with("+ second:1@pc1 4 bytes, depth 4, "));
  output({"rm", "first"});
  EXPECT_EQ(watch.line(), "- first:0@pc1");
  watch.signal(SIGINT);
  EXPECT_EQ(watch.rest(), "");
  EXPECT_EQ(watch.status(), 0);
}

TEST_F(LsWatch, PrintsOneJsonObjectPerLine) {
  Running watch(argv({"ls", "--watch", "--json", "l*"}), environment());
  output({"create", "odom", "--size", "4", "--depth", "4"});
  output({"create", "lidar", "--size", "4", "--depth", "4"});
  const Json added = Json::parse(watch.line());
  EXPECT_EQ(added["event"], "added");
  EXPECT_EQ(added["stream"], "lidar:0@pc1");
  EXPECT_EQ(added["payload_bytes"], 4);
  for (const char* key : {"writers", "readers", "channels", "newest_tid", "rate_hz", "state"}) {
    EXPECT_TRUE(added.contains(key) && added[key].is_null()) << "an event does not know " << key;
  }
  output({"rm", "odom", "lidar"});
  const Json removed = Json::parse(watch.line());
  EXPECT_EQ(removed, Json::parse(R"({"event":"removed","stream":"lidar:0@pc1","name":"lidar",
                                     "id":0,"host":"pc1"})"));
  watch.signal(SIGTERM);
  watch.rest();
  EXPECT_EQ(watch.status(), 0);
}

TEST_F(LsWatch, ShowsAfterARestartOfDssmdOnlyWhatHasChanged) {
  auto kept = session_.create<double>("kept", depth_of(4)).value();
  output({"create", "orphan", "--size", "4", "--depth", "4"});
  Running watch(argv({"ls", "--watch"}), environment());
  std::set<std::string> there;
  // Each line is a change: nothing comes that is there already, nothing goes that is not.
  const auto await_there = [&](const std::set<std::string>& wanted) {
    while (there != wanted) {
      const Strings words = words_of(watch.line());
      ASSERT_GE(words.size(), 2U);
      const bool changed =
          words[0] == "+" ? there.insert(words[1]).second : there.erase(words[1]) == 1;
      EXPECT_TRUE(changed) << words[0] << " " << words[1];
    }
  };
  await_there({"kept:0@pc1", "orphan:0@pc1"});
  daemon_.kill_hard();
  daemon_.start();
  await_there({"kept:0@pc1"});  // nobody held the other one
  // This process may have offered its stream only after dssmctl was told what there is.
  output({"create", "last", "--size", "4", "--depth", "4"});
  await_there({"kept:0@pc1", "last:0@pc1"});
}

TEST_F(LsWatch, ShowsThatAStreamWasRecreatedWhileItWasDisconnected) {
  output({"create", "s", "--size", "4", "--depth", "4"});
  Running watch(argv({"ls", "--watch"}), environment());
  EXPECT_TRUE(watch.line().starts_with("+ s:0@pc1 4 bytes"));
  watch.stop();
  daemon_.kill_hard();
  daemon_.start();
  output({"create", "s", "--size", "8", "--depth", "4"});
  watch.signal(SIGCONT);
  EXPECT_EQ(watch.line(), "- s:0@pc1");
  EXPECT_TRUE(watch.line().starts_with("+ s:0@pc1 8 bytes"));
}

TEST_F(LsWatch, EndsQuietlyWhenItsReaderHasEnough) {
  output({"create", "s", "--size", "4", "--depth", "4"});
  Running watch(argv({"ls", "--watch"}), environment());
  EXPECT_TRUE(watch.line().starts_with("+ s:0@pc1 "));
  watch.close_output();
  EXPECT_EQ(watch.status(), 0);
}

}  // namespace
}  // namespace dssm::test
