// SPDX-License-Identifier: Apache-2.0
//
// Runs the programs of programs/ that meet other PCs: those of the remote interface, and SSM
// programs that open another PC's stream by its name.
#include <gtest/gtest.h>

#include <algorithm>
#include <dssm/dssm.hpp>
#include <thread>

#include "tests/process/fleet/fleet_tools.hpp"
#include "tests/process/ssm/run_program.hpp"
#include "tests/support/await.hpp"
#include "tests/support/daemon_process.hpp"
#include "tests/support/session.hpp"

namespace dssm::test {
namespace {

using namespace std::chrono_literals;

std::string program(const std::string& name) { return built("tests/process/ssm/" + name); }

class SsmRemoteProgram : public testing::TestWithParam<std::string> {};

TEST_P(SsmRemoteProgram, ChecksHold) { expect_checks_hold(GetParam(), true); }

class SsmRemoteProcesses : public testing::TestWithParam<std::string> {};

TEST_P(SsmRemoteProcesses, ChecksHold) { expect_checks_hold(GetParam(), true); }

INSTANTIATE_TEST_SUITE_P(Cpp, SsmRemoteProgram,
                         testing::Values("remote_api-c++11", "remote_api-c++14", "remote_api-c++17",
                                         "remote_api-c++20", "remote_prototype-c++11",
                                         "remote_prototype-c++20"),
                         test_name);
INSTANTIATE_TEST_SUITE_P(Cpp, SsmRemoteProcesses,
                         testing::Values("remote_buffered-c++11", "remote_buffered-c++20",
                                         "remote_signals-c++11"),
                         test_name);

// Two PCs, of which the first knows the second.
struct SsmFleet : testing::Test {
  DaemonProcess pc2{{"--log-level", "warning"}, "pc2"};
  DaemonProcess pc1{{"--log-level", "warning", "--peer", pc2.address()}, "pc1"};

  static void await_host(const DaemonProcess& daemon, const std::string& name) {
    auto session = connect(daemon);
    await_up(session, name);
  }
};

struct Point {
  std::int32_t number;
  double x;
};

TEST_F(SsmFleet, AnSsmProgramReadsAndWritesStreamsOfAnotherPcByTheirNames) {
  auto far = connect(pc2);
  auto writer =
      far.create_raw({"far", 3, {}}, {"", sizeof(Point), 1, {}}, History{100, 100ms}).value();
  for (std::int32_t i = 0; i < 10; ++i) {
    const Point point{i, 0.5 * i};
    writer.write(std::as_bytes(std::span(&point, 1)), time_from_ns((1000LL + i) * 1'000'000'000));
  }
  const int property = 99;
  ASSERT_TRUE(writer.set_property(std::as_bytes(std::span(&property, 1))));
  await_host(pc1, "pc2");
  const std::string folder = make_temp_dir();
  const Finished finished =
      run({program("remote_names-gnu++98"), folder, "pc2", std::to_string(pc1.pid())},
          {pc1.environment()});
  EXPECT_EQ(finished.exit_status, 0) << finished.out << finished.err;
  remove_tree(folder);
  EXPECT_TRUE(far.stream_info({"ours", 0, {}}));
}

TEST_F(SsmFleet, AStreamThatAnotherPcWritesIsShownAsComingFromDssmd) {
  await_host(pc1, "pc2");
  auto far = connect(pc1), near = connect(pc2);
  const auto writer =
      far.create_raw({"back", 0, "pc2"}, {"", sizeof(Point), 1, {}}, History{100, 100ms}).value();
  const auto reader = near.open_raw_reader({"back", 0, {}}).value();
  const std::string edge = "\t" + std::to_string(pc2.pid()) + " -> " + std::to_string(::getpid()) +
                           " [ label = \"back[0]\"];\n";
  await([&] {
    const Finished graph = run({built("client/ssm/ssm-graph")}, {pc2.environment()});
    return graph.exit_status == 0 && graph.out.find(edge) != std::string::npos;
  });
}

TEST(SsmBroadcast, EachHostSeesWhatAllShow) {
  // Both need the other's address: the second one's comes by starting it on the port it had.
  auto second =
      std::make_unique<DaemonProcess>(std::vector<std::string>{"--log-level", "warning"}, "pc2");
  const DaemonProcess first({"--log-level", "warning", "--peer", second->address()}, "pc1");
  const std::string at = second->address();
  second.reset();
  second = std::make_unique<DaemonProcess>(
      std::vector<std::string>{"--log-level", "warning", "--listen", at, "--peer", first.address()},
      "pc2");
  const std::string folders[] = {make_temp_dir(), make_temp_dir()};
  Finished one, two;
  std::thread other([&] {
    two = run({program("remote_broadcast-c++11"), folders[1], "22", "11"}, {second->environment()});
  });
  one = run({program("remote_broadcast-c++11"), folders[0], "11", "22"}, {first.environment()});
  other.join();
  EXPECT_EQ(one.exit_status, 0) << one.out << one.err;
  EXPECT_EQ(two.exit_status, 0) << two.out << two.err;
  for (const std::string& folder : folders) remove_tree(folder);
}

struct SsmNewRing : testing::Test {
  DaemonProcess daemon{{"--log-level", "warning"}};
  Session session = connect(daemon);
  std::string folder = make_temp_dir();
  int number = 0;
  RawWriter writer = make();

  ~SsmNewRing() override { remove_tree(folder); }

  RawWriter make() {
    return session.create_raw({"recreated", 0, {}}, {"", sizeof(int), 1, {}}, History{64, 1ms})
        .value();
  }
  void write(int count) {
    for (int i = 0; i < count; ++i, ++number) {
      writer.write(std::as_bytes(std::span(&number, 1)));
    }
  }
  // Until the program has read all that was written.
  void await(const PipedProgram& program) {
    const std::string last = std::to_string(number - 1);
    program.write_line(last + "\n");
    ASSERT_EQ(program.line(), last);
  }
  void replace_ring() {
    ASSERT_TRUE(session.remove({"recreated", 0, {}}));
    writer = make();
  }
};

TEST_F(SsmNewRing, LoopsOfOldProgramsContinue) {
  write(1);
  PipedProgram piped({program("cpp_recreated-gnu++98"), folder}, daemon.environment());
  for (int round = 0; round < 4; ++round) {
    write(5);
    await(piped);
    replace_ring();
  }
  std::string rest;
  EXPECT_EQ(piped.end(rest), 0) << rest;
}

TEST_F(SsmNewRing, RemoteProgramsAreListedAndCounted) {
  write(1);
  PipedProgram piped({program("remote_recreated-c++11"), folder, daemon.address()},
                     daemon.environment());
  write(5);
  await(piped);
  const std::vector<NodeInfo> nodes = session.list_nodes().value();
  const auto node = std::find_if(nodes.begin(), nodes.end(), [&](const NodeInfo& one) {
    return one.program == "remote_recreated-c++11";
  });
  ASSERT_NE(node, nodes.end());
  EXPECT_GT(node->pid, 0);
  ASSERT_EQ(node->streams.size(), 1U);
  EXPECT_EQ(node->streams[0].stream, writer.id());
  EXPECT_EQ(node->streams[0].role, Role::reader);
  EXPECT_EQ(node->streams[0].via, StreamVia::connection);
  const StreamInfo listed = session.list_streams().value().at(0);
  EXPECT_EQ(listed.readers, 4U) << "three connections, and one that fills the buffer";
  EXPECT_EQ(listed.remote_readers, 4U);
  EXPECT_EQ(listed.writers, 1U) << "this test";
  std::string rest;
  EXPECT_EQ(piped.end(rest), 0) << rest;
  test::await([&] { return session.list_streams().value().at(0).readers == 0; });
}

TEST_F(SsmNewRing, RemoteLoopsOfOldProgramsContinueOverRestartsOfDssmdToo) {
  write(1);
  PipedProgram piped({program("remote_recreated-c++11"), folder, daemon.address()},
                     daemon.environment());
  for (int round = 0; round < 6; ++round) {
    write(5);
    await(piped);
    if (round % 2 == 0) {
      replace_ring();
    } else {
      daemon.kill_hard();
      write(5);
      daemon.start();
    }
  }
  std::string rest;
  EXPECT_EQ(piped.end(rest), 0) << rest;
}

}  // namespace
}  // namespace dssm::test
