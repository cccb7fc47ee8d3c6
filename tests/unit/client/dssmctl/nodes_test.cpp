// SPDX-License-Identifier: Apache-2.0
#include "client/dssmctl/nodes.hpp"

#include <gtest/gtest.h>

#include "tests/unit/client/dssmctl/printed.hpp"

namespace dssm::ctl {
namespace {

NodeInfo mapper() {
  NodeInfo node{"pc2", 12, 1000, "mapper", {}, {}};
  node.streams = {{{"lidar", 0, "pc1"}, Role::reader, StreamVia::mirror},
                  {{"map", 1, "pc2"}, Role::writer, StreamVia::local},
                  {{"odometry", 0, "pc2"}, Role::reader, StreamVia::local}};
  return node;
}

NodeInfo viewer() {
  NodeInfo node{"laptop", 0, {}, "viewer", {}, {}};
  node.streams = {{{"lidar", 0, "pc1"}, Role::reader, StreamVia::connection}};
  return node;
}

NodeInfo silent() { return {"pc3", 0, {}, "", {}, "host 'pc3' has not answered within 500 ms"}; }

TEST(Nodes, AreATableWithARowForEachStream) {
  EXPECT_EQ(printed([](Output& out) {
              print_nodes({mapper(), viewer(), silent()}, out);
            }),
            "HOST    PID  PROGRAM  WRITES  READS\n"
            "pc2      12  mapper   map:1   lidar@pc1\n"
            "                              odometry\n"
            "laptop    -  viewer   -       lidar@pc1\n"
            "pc3: not known: host 'pc3' has not answered within 500 ms\n");
}

TEST(Nodes, AreJsonWithNullForWhatIsNotKnown) {
  EXPECT_EQ(json_text(node_json(mapper())),
            R"({"host":"pc2","pid":12,"uid":1000,"program":"mapper",)"
            R"("writes":[{"stream":"map:1@pc2","via":"local"}],)"
            R"("reads":[{"stream":"lidar:0@pc1","via":"mirror"},)"
            R"({"stream":"odometry:0@pc2","via":"local"}],"error":null})");
  EXPECT_EQ(json_text(node_json(viewer())),
            R"({"host":"laptop","pid":null,"uid":null,"program":"viewer","writes":[],)"
            R"("reads":[{"stream":"lidar:0@pc1","via":"connection"}],"error":null})");
  EXPECT_EQ(json_text(node_json(silent())),
            R"({"host":"pc3","pid":null,"uid":null,"program":null,"writes":[],"reads":[],)"
            R"("error":"host 'pc3' has not answered within 500 ms"})");
}

TEST(Graph, PointsFromWritersToReadersInAFramePerHost) {
  StreamInfo lidar, unused;
  lidar.id = {"lidar", 0, "pc1"};
  lidar.rate_hz = 10;
  unused.id = {"unused", 3, "pc1"};
  EXPECT_EQ(dot_graph({mapper(), viewer(), silent()}, {lidar, unused}),
            R"(digraph dssm {
  rankdir=LR;
  node [fontname="sans-serif"];
  graph [fontname="sans-serif"];
  subgraph cluster_0 {
    label="laptop";
    p1 [shape=ellipse, label="viewer"];
  }
  subgraph cluster_1 {
    label="pc1";
    s0 [shape=box, label="lidar\n10.0 Hz"];
    s1 [shape=box, label="unused:3"];
  }
  subgraph cluster_2 {
    label="pc2";
    p0 [shape=ellipse, label="mapper\npid 12"];
    s2 [shape=box, label="map:1"];
    s3 [shape=box, label="odometry"];
  }
  subgraph cluster_3 {
    label="pc3\nprocesses not known";
    h3 [style=invis];
  }
  s0 -> p0 [style=dashed];
  p0 -> s2;
  s3 -> p0;
  s0 -> p1 [style=dashed];
}
)");
}

TEST(Graph, ShowsNamesAsTheyAre) {
  EXPECT_EQ(dot_text("lidar"), "lidar");
  EXPECT_EQ(dot_text(R"(a "b")"), R"(a \"b\")");
  EXPECT_EQ(dot_text(R"(a\N)"), R"(a\\N)") << "not the name of the node";
  EXPECT_EQ(dot_text("a\nb"), R"(a\\nb)") << "as in all of dssmctl's output";
  EXPECT_EQ(dot_text("a&lt;"), "a&amp;lt;") << "not '<'";
  EXPECT_EQ(dot_text("\xc3\xbc"
                     "ber"),
            "\xc3\xbc"
            "ber");
  EXPECT_EQ(dot_text("\xff"), R"(\\xff)");
}

}  // namespace
}  // namespace dssm::ctl
