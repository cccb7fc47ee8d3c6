// SPDX-License-Identifier: Apache-2.0
//
// dssmctl create and rm.
#include "tests/process/dssmctl/ctl_test.hpp"

namespace dssm::test {
namespace {

using namespace std::chrono_literals;

using Create = CtlTest;
using Rm = CtlTest;

TEST_F(Create, MakesAStreamOfTheGivenShapeThatStays) {
  const Json created = json(
      {"create", "s:2", "--size", "24", "--depth", "10", "--cycle", "0.025", "--type", "Odometry"});
  EXPECT_EQ(created, Json::parse(R"({"stream":"s:2@pc1","created":true,"payload_bytes":24,
                                      "depth":10,"cycle_ns":25000000})"));
  const StreamInfo info = session_.stream_info({"s", 2, ""}).value();
  EXPECT_EQ(info.type.payload_bytes, 24U);
  EXPECT_EQ(info.type.alignment_bytes, 8U);
  EXPECT_EQ(info.type.name, "Odometry");
  EXPECT_EQ(info.depth, 10U);
  EXPECT_EQ(info.cycle, 25ms);
  // dssmd notices the end of the program that created it by its connection.
  await([&] { return session_.stream_info({"s", 2, ""}).value().writers == 0; });
}

TEST_F(Create, ComputesTheDepthFromLifeAndCycle) {
  const History history = History::for_life(2s, 10ms).value();
  EXPECT_EQ(json({"create", "s", "--size", "4", "--life", "2", "--cycle", "0.01"})["depth"],
            history.depth);
  EXPECT_NE(output({"create", "t", "--size", "4", "--life", "2", "--cycle", "0.01"})
                .find("t:0@pc1: created with " + std::to_string(history.depth) + " slots"),
            std::string::npos);
}

TEST_F(Create, KeepsAStreamThatIsThereAlready) {
  output({"create", "s", "--size", "24", "--depth", "10"});
  const std::uint64_t incarnation = session_.stream_info({"s", 0, ""}).value().incarnation;
  const Json again = json({"create", "s", "--size", "24", "--depth", "99"});
  EXPECT_EQ(again["created"], false);
  EXPECT_EQ(again["depth"], 10);
  EXPECT_EQ(session_.stream_info({"s", 0, ""}).value().incarnation, incarnation);
  EXPECT_EQ(output({"create", "s", "--size", "24", "--depth", "99"}),
            "s:0@pc1: exists already, kept with 10 slots of 24 bytes, fewer than the 99 asked for; "
            "remove it first to get those\n");
}

TEST_F(Create, RefusesAnotherSizeNamingBoth) {
  output({"create", "s", "--size", "24", "--depth", "10"});
  const Finished finished = ctl({"create", "s", "--size", "25", "--depth", "10"});
  EXPECT_EQ(finished.exit_status, 1);
  EXPECT_NE(finished.err.find("24 bytes"), std::string::npos) << finished.err;
  EXPECT_NE(finished.err.find("25 bytes"), std::string::npos) << finished.err;
  EXPECT_TRUE(contains(finished.err, "dssmctl rm s:0@pc1")) << finished.err;
  EXPECT_FALSE(contains(finished.err, "compile")) << finished.err;
}

TEST_F(Create, RefusesImpossibleNamesAndLivesAsWrongUsage) {
  const std::string long_name(32, 'n');
  for (const std::string& name :
       {std::string("a@b@c"), std::string("a:x"), std::string("a\nb"), long_name}) {
    const Finished finished = ctl({"create", name, "--size", "4", "--depth", "10"});
    EXPECT_EQ(finished.exit_status, 2) << name;
    EXPECT_EQ(finished.err.find('\n'), finished.err.size() - 1) << finished.err;
  }
  const Finished too_short = ctl({"create", "s", "--size", "4", "--life", "0.1", "--cycle", "2h"});
  EXPECT_EQ(too_short.exit_status, 2);
  EXPECT_TRUE(contains(too_short.err, "a life of 100 ms is shorter than the cycle of 7200 s"))
      << too_short.err;
  EXPECT_EQ(session_.list_streams().value().size(), 0U);
}

TEST_F(Rm, RemovesStreams) {
  for (const char* name : {"a", "b", "c:1"})
    output({"create", name, "--size", "4", "--depth", "4"});
  EXPECT_EQ(output({"rm", "a"}), "a:0@pc1: removed\n");
  EXPECT_EQ(json({"rm", "b", "c:1"}), Json::parse(R"({"removed":["b:0@pc1","c:1@pc1"]})"));
  EXPECT_EQ(session_.list_streams().value().size(), 0U);
}

TEST_F(Rm, RemovesTheOthersWhenOneIsMissing) {
  for (const char* name : {"lidar", "odom"})
    output({"create", name, "--size", "4", "--depth", "4"});
  const Finished finished = ctl({"rm", "lidr", "odom", "nope"});
  EXPECT_EQ(finished.exit_status, 1);
  EXPECT_TRUE(finished.err.starts_with("dssmctl: rm: ")) << finished.err;
  EXPECT_NE(finished.err.find("is it 'lidar'?; and "), std::string::npos) << finished.err;
  EXPECT_NE(finished.err.find("'nope:0'"), std::string::npos) << finished.err;
  EXPECT_EQ(output({"ls", "--names"}), "lidar\n");
}

}  // namespace
}  // namespace dssm::test
