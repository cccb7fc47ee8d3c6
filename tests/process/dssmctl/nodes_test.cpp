// SPDX-License-Identifier: Apache-2.0
//
// dssmctl nodes and graph, and who uses a stream in ls and info.
#include <signal.h>
#include <sys/stat.h>
#include <unistd.h>

#include <cstdlib>
#include <fstream>
#include <sstream>

#include "tests/process/dssmctl/fleet_test.hpp"

namespace dssm::test {
namespace {

using Strings = std::vector<std::string>;

// pc2 writes "lidar" and pc1 reads it; the process is this test.
class Nodes : public FleetTest {
 protected:
  Nodes() { await_streams(1); }

  // Runs dssmctl with this as the only, or first, folder of programs.
  Finished with_programs_in(const std::string& path, Strings words) {
    return run(argv(std::move(words)), {daemon_.environment(), "PATH=" + path});
  }

  const std::string pid = std::to_string(::getpid());
  Writer<double> writer = on_pc2_.create<double>("lidar", depth_of(4)).value();
  Reader<double> reader = session_.open_reader<double>("lidar@pc2").value();
};

TEST_F(Nodes, ShowTheProcessesOfAllHosts) {
  Strings lines;
  const auto is_whole = [&] {  // pc2 has answered in time
    lines = lines_of(output({"nodes"}));
    return lines.size() == 3 && !contains(lines[2], "not known");
  };
  await(is_whole);
  EXPECT_EQ(words_of(lines[0]), (Strings{"HOST", "PID", "PROGRAM", "WRITES", "READS"}));
  EXPECT_EQ(words_of(lines[1]), (Strings{"pc1", pid, "the", "test", "-", "lidar@pc2"}));
  EXPECT_EQ(words_of(lines[2]), (Strings{"pc2", pid, "the", "test", "lidar", "-"}));

  const Json nodes = json({"nodes"})["nodes"];
  ASSERT_EQ(nodes.size(), 2U);
  EXPECT_EQ(nodes[0]["host"], "pc1");
  EXPECT_EQ(nodes[0]["pid"], ::getpid());
  EXPECT_EQ(nodes[0]["uid"], ::getuid());
  EXPECT_EQ(nodes[0]["reads"][0], Json({{"stream", "lidar:0@pc2"}, {"via", "mirror"}}));
  EXPECT_EQ(nodes[1]["writes"][0], Json({{"stream", "lidar:0@pc2"}, {"via", "local"}}));
}

TEST_F(Nodes, AreChosenByProgramAndHost) {
  EXPECT_EQ(json({"nodes", "the*"})["nodes"].size(), 2U);
  EXPECT_EQ(json({"nodes", "the"})["nodes"].size(), 0U);
  const Json on_pc2 = json({"nodes", "--host", "pc2"})["nodes"];
  ASSERT_EQ(on_pc2.size(), 1U);
  EXPECT_EQ(on_pc2[0]["host"], "pc2");
  EXPECT_EQ(json({"nodes", "--host", "pc3"})["nodes"].size(), 0U)
      << "known, and nothing runs there";
  const Finished none = ctl({"nodes", "the"});
  EXPECT_EQ(none.exit_status, 0);
  EXPECT_EQ(lines_of(none.out).size(), 1U) << "the header";
  EXPECT_EQ(none.err,
            "dssmctl: nodes: no process whose program fits 'the' has a stream open; there are 2 "
            "others\n");
  EXPECT_EQ(ctl({"nodes", "the", "--json"}).err, "");
  EXPECT_EQ(ctl({"nodes", "--host", "pc3"}).err,
            "dssmctl: nodes: no process of these hosts has a stream open; there are 2 others\n");
  EXPECT_EQ(ctl({"nodes", "the*"}).err, "");
  // Unless dssmctl begins so late that pc3 is down.
  await([&] {
    await_state("pc3", HostState::up);
    ::kill(pc3_.pid(), SIGSTOP);
    const std::string silent = output({"nodes", "the*"});
    ::kill(pc3_.pid(), SIGCONT);
    return contains(silent, "pc3: not known: ");
  });
  const Finished unknown = ctl({"nodes", "--host", "pc9"});
  EXPECT_EQ(unknown.exit_status, 1);
  EXPECT_TRUE(contains(unknown.err, "known are 'pc1', 'pc2', 'pc3'")) << unknown.err;
}

TEST_F(Nodes, CountInLsAndAreNamedInInfo) {
  await([&] { return json({"ls"})["streams"][0]["readers"] == 1; });
  const Json listed = json({"ls"})["streams"][0];
  EXPECT_EQ(listed["writers"], 1);
  EXPECT_EQ(listed["remote_readers"], 1);
  EXPECT_EQ(listed["remote_writers"], 0);
  const Json users = json({"info", "lidar"})["users"];
  ASSERT_EQ(users.size(), 2U);
  EXPECT_EQ(users[0]["host"], "pc2");
  EXPECT_EQ(users[0]["via"], "local");
  EXPECT_EQ(users[1]["host"], "pc1");
  EXPECT_EQ(users[1]["via"], "mirror");
  EXPECT_EQ(users[1]["pid"], ::getpid());
  const std::string info = output({"info", "lidar"});
  EXPECT_TRUE(contains(info, "readers:      1, 1 of them over the network\n")) << info;
  EXPECT_TRUE(contains(info, "USED BY   ROLE    HOST")) << info;
}

TEST_F(Nodes, AreDrawnByGraphvizIfItIsThere) {
  const std::string graph = output({"graph"});
  EXPECT_TRUE(graph.starts_with("digraph dssm {\n")) << graph;
  EXPECT_TRUE(contains(graph, "label=\"the test\\npid " + pid + "\"")) << graph;
  const std::string folder = daemon_.runtime_dir();
  EXPECT_EQ(output({"graph", "--out", folder + "/a.dot"}), "");
  EXPECT_EQ(text_of(folder + "/a.dot"), graph);
  EXPECT_EQ(json({"graph"})["nodes"], json({"nodes"})["nodes"]);
  EXPECT_EQ(json({"graph"})["streams"][0]["stream"], "lidar:0@pc2");

  const std::string bin = folder + "/bin", svg = folder + "/a b.svg";
  ASSERT_EQ(::mkdir(bin.c_str(), 0755), 0);
  const Finished missing = with_programs_in(bin, {"graph", "--out", svg});
  EXPECT_EQ(missing.exit_status, 1);
  EXPECT_TRUE(contains(missing.err, "apt install graphviz")) << missing.err;
  const char* path = std::getenv("PATH");
  std::ofstream(bin + "/dot") << "#!/bin/sh\necho \"$1 $2\" > \"$3\"; cat >> \"$3\"\n";
  ASSERT_EQ(::chmod((bin + "/dot").c_str(), 0755), 0);
  const std::string both = bin + ":" + (path ? path : "/usr/bin:/bin");
  EXPECT_EQ(with_programs_in(both, {"graph", "--out", svg}).exit_status, 0);
  EXPECT_EQ(text_of(svg), "-Tsvg -o\n" + graph);
  std::ofstream(bin + "/dot") << "#!/bin/sh\necho 'bad graph' >&2; exit 1\n";
  const Finished failed = with_programs_in(both, {"graph", "--out", svg});
  EXPECT_EQ(failed.exit_status, 1);
  EXPECT_TRUE(contains(failed.err, "bad graph\ndssmctl: graph: draw '")) << failed.err;
}

}  // namespace
}  // namespace dssm::test
