// SPDX-License-Identifier: Apache-2.0
//
// The vehicle on several hosts: programs and options are the same as on one, so the map must be the
// same, byte for byte. The hosts are dssmd processes that connect by loopback addresses.
#include <gtest/gtest.h>
#include <unistd.h>

#include <algorithm>
#include <cstdlib>
#include <memory>
#include <random>
#include <string>
#include <vector>

#include "docs/examples/vehicle/carmen_log.hpp"
#include "tests/process/vehicle/drive.hpp"

namespace vehicle {
namespace {

using dssm::test::DaemonProcess;
using test::Placed;

constexpr double kToS = 200;

test::Command source(const std::string& name) { return test::source(name, kToS); }

// Loopback addresses that only this process uses, so that ports are known before dssmd listens.
std::string own_address(int host) {
  const int pid = ::getpid();
  return "127." + std::to_string(100 + host) + "." + std::to_string(pid / 256 % 256) + "." +
         std::to_string(pid % 256) + ":13776";
}

// A dssmd called pcHOST with `hosts` peers, one of which is itself, as in vehicle.conf. It keeps
// its mirrors after the last reader, so that a test can inspect them.
std::unique_ptr<DaemonProcess> start_host(int host, int hosts) {
  std::vector<std::string> flags{"--listen", own_address(host), "--mirror-linger", "1000 s"};
  for (int peer = 1; peer <= hosts; ++peer) {
    flags.insert(flags.end(), {"--peer", own_address(peer)});
  }
  return std::make_unique<DaemonProcess>(flags, "pc" + std::to_string(host));
}

// The mirror of `stream` on `host` has no gap.
void expect_no_gap(const DaemonProcess& host, const std::string& stream) {
  dssm::Session session = test::connect(host);
  const dssm::StreamInfo info = session.stream_info(dssm::StreamId{stream, 0, ""}).value();
  ASSERT_TRUE(info.mirror) << info.id.str();
  EXPECT_EQ(info.mirror->gap_samples, 0u) << info.id.str();
}

class VehicleHosts : public testing::Test {
 protected:
  ~VehicleHosts() override { dssm::test::remove_tree(dir_); }

  const std::string dir_ = dssm::test::make_temp_dir();

  std::string map_path(const std::string& name) const { return dir_ + "/" + name + ".png"; }

  // The map of a single host; readers start after all samples are written.
  const std::string& map_of_one_host() const {
    static const std::string map = [&] {
      const DaemonProcess pc({"--listen", "127.0.0.1:0"});
      test::run_all({{&pc, source("encoder")}, {&pc, source("lidar")}});
      test::run_all({{&pc, test::localizer()}});
      test::run_all({{&pc, test::mapper(map_path("one"))}});
      return test::content(map_path("one"));
    }();
    return map;
  }

  static dssm::Tid scans_and_end_mark() {
    const CarmenLog log = read_carmen_log(test::recording()).value();
    return 1 + std::count_if(log.scans.begin(), log.scans.end(),
                             [](const ScanReading& scan) { return scan.time_s <= kToS; });
  }
};

TEST_F(VehicleHosts, DrawTheSameMapAsOneHostInAnyStartOrder) {
  const std::string expected = map_of_one_host();
  ASSERT_FALSE(expected.empty());
  const unsigned seed = std::random_device()();
  SCOPED_TRACE("seed " + std::to_string(seed));
  std::mt19937 random(seed);
  for (const int hosts : {2, 3}) {
    SCOPED_TRACE(std::to_string(hosts) + " hosts");
    const auto pc1 = start_host(1, hosts), pc2 = start_host(2, hosts);
    const auto pc3 = hosts == 3 ? start_host(3, hosts) : nullptr;
    std::vector<Placed> programs{{pc1.get(), source("encoder")},
                                 {pc2.get(), source("lidar")},
                                 {pc2.get(), test::localizer()},
                                 {(pc3 ? pc3 : pc2).get(), test::mapper(map_path("map"))}};
    std::shuffle(programs.begin(), programs.end(), random);
    test::run_all(programs);
    EXPECT_EQ(test::content(map_path("map")), expected);
    EXPECT_EQ(test::written(*pc2, "lidar"), scans_and_end_mark());
    EXPECT_EQ(test::written(*pc2, "pose"), scans_and_end_mark());
    expect_no_gap(*pc2, "odometry");
    if (pc3) {
      expect_no_gap(*pc3, "lidar");
      expect_no_gap(*pc3, "pose");
    }
  }
}

TEST_F(VehicleHosts, DrawTheSameMapWhenReadersStartAfterTheDrive) {
  const std::string expected = map_of_one_host();
  const DaemonProcess pc1({"--listen", "127.0.0.1:0"}, "pc1");
  test::run_all({{&pc1, source("encoder")}, {&pc1, source("lidar")}});
  const DaemonProcess pc2({"--listen", "127.0.0.1:0", "--peer", pc1.address()}, "pc2");
  test::run_all({{&pc2, test::localizer()}});
  const DaemonProcess pc3(
      {"--listen", "127.0.0.1:0", "--peer", pc1.address(), "--peer", pc2.address()}, "pc3");
  test::run_all({{&pc3, test::mapper(map_path("map"))}});
  EXPECT_EQ(test::content(map_path("map")), expected);
}

TEST_F(VehicleHosts, WaitForAHostThatStartsLate) {
  const std::string expected = map_of_one_host();
  const auto pc2 = start_host(2, 3), pc3 = start_host(3, 3);
  const pid_t localizing = dssm::test::start(test::localizer(), {pc2->environment()});
  const pid_t mapping = dssm::test::start(test::mapper(map_path("map")), {pc3->environment()});
  test::run_all({{pc2.get(), source("lidar")}});
  // The localizer creates its stream when it has opened the lidar's; then it waits for the
  // odometry.
  dssm::Session session = test::connect(*pc3);
  (void)session.await_raw_reader(dssm::StreamId{"pose", 0, ""}, dssm::kNever).value();
  const auto pc1 = start_host(1, 3);
  test::run_all({{pc1.get(), source("encoder")}});
  EXPECT_EQ(dssm::test::wait_for(localizing), 0);
  EXPECT_EQ(dssm::test::wait_for(mapping), 0);
  EXPECT_EQ(test::content(map_path("map")), expected);
}

TEST_F(VehicleHosts, DrawTheSameMapWhenEachDssmdIsKilledDuringTheDrive) {
  const std::string expected = map_of_one_host();
  const auto pc1 = start_host(1, 3), pc2 = start_host(2, 3), pc3 = start_host(3, 3);
  std::vector<pid_t> programs{
      dssm::test::start(test::localizer(), {pc2->environment()}),
      dssm::test::start(test::mapper(map_path("map")), {pc3->environment()}),
      dssm::test::start(test::source("lidar", kToS, {"--speed", "100"}), {pc2->environment()}),
      dssm::test::start(test::source("encoder", kToS, {"--speed", "100"}), {pc1->environment()})};
  // The encoder may be done when its dssmd is killed; then this reader gives its stream back.
  dssm::Session at_pc1 = test::connect(*pc1);
  const dssm::RawReader odometry =
      at_pc1.await_raw_reader(dssm::StreamId{"odometry", 0, ""}, dssm::kNever).value();
  dssm::Session session = test::connect(*pc2);
  dssm::RawReader poses =
      session.await_raw_reader(dssm::StreamId{"pose", 0, ""}, dssm::kNever).value();
  dssm::Tid reached = 0;
  for (DaemonProcess* dssmd : {pc1.get(), pc2.get(), pc3.get()}) {
    reached += scans_and_end_mark() / 5;
    while (poses.newest_tid() < reached) (void)poses.wait_for_tid(reached, dssm::kNever);
    dssmd->kill_hard();
    dssmd->start();
  }
  for (const pid_t pid : programs) EXPECT_EQ(dssm::test::wait_for(pid), 0);
  EXPECT_EQ(test::content(map_path("map")), expected);
}

TEST_F(VehicleHosts, HaveAValidConfiguration) {
  const std::string path =
      std::string(std::getenv("DSSM_SOURCE_ROOT")) + "/docs/examples/vehicle/vehicle.conf";
  const dssm::test::Finished checked =
      dssm::test::run({dssm::test::built("daemon/dssmd"), "--config", path, "--check-config"});
  EXPECT_EQ(checked.exit_status, 0) << checked.err;
}

TEST_F(VehicleHosts, ReportLostSamples) {
  constexpr int kIncomplete = 3;
  const DaemonProcess pc1({"--listen", "127.0.0.1:0"}, "pc1");
  const DaemonProcess pc2({"--listen", "127.0.0.1:0", "--peer", pc1.address()}, "pc2");
  // The ring holds only the last seconds when the readers start.
  test::run_all(
      {{&pc1, source("encoder")},
       {&pc1, test::program("lidar", {"--log", test::recording(), "--to", std::to_string(kToS),
                                      "--life", "20", "--speed", "0"})}});
  const dssm::test::Finished localized = dssm::test::run(test::localizer(), {pc2.environment()});
  EXPECT_EQ(localized.exit_status, kIncomplete);
  EXPECT_NE(localized.err.find("scans missed"), std::string::npos) << localized.err;
  // The poses still exist, but their scans do not.
  test::connect(pc1).remove(dssm::StreamId{"lidar", 0, ""}).value();
  test::run_all({{&pc1, test::source("lidar", 1)}});
  const dssm::test::Finished mapped = dssm::test::run(
      test::program("mapper",
                    {"--late", "--complete", "--deadline", "0", "--out", map_path("map")}),
      {pc2.environment()});
  EXPECT_EQ(mapped.exit_status, kIncomplete);
  EXPECT_NE(mapped.err.find("poses without their scan"), std::string::npos) << mapped.err;
}

}  // namespace
}  // namespace vehicle
