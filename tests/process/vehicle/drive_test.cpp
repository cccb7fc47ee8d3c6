// SPDX-License-Identifier: Apache-2.0
//
// The whole drive: the four programs, with a dssmd of their own, replay the first minute of the
// recording without pauses.
#include "tests/process/vehicle/drive.hpp"

#include <gtest/gtest.h>
#include <png.h>
#include <signal.h>

#include <algorithm>
#include <cmath>
#include <dssm/dssm.hpp>
#include <iterator>
#include <random>
#include <string>
#include <vector>

#include "docs/examples/vehicle/carmen_log.hpp"
#include "docs/examples/vehicle/map_picture.hpp"
#include "docs/examples/vehicle/occupancy_grid.hpp"
#include "docs/examples/vehicle/resample.hpp"
#include "tests/support/await.hpp"

namespace vehicle {
namespace {

using dssm::test::DaemonProcess;
using test::Command;
using test::connect;
using test::content;
using test::localizer;
using test::mapper;
using test::program;
using test::recording;
using test::written;

constexpr double kToS = 60;
constexpr double kEncoderCycleS = 0.05;  // the encoder's default

Command source(const std::string& name, const Command& more = {"--speed", "0"}) {
  return test::source(name, kToS, more);
}

void run_all(const DaemonProcess& daemon, const std::vector<Command>& commands) {
  std::vector<test::Placed> programs;
  for (const Command& command : commands) programs.push_back({&daemon, command});
  test::run_all(programs);
}

class VehicleDrive : public testing::Test {
 protected:
  ~VehicleDrive() override { dssm::test::remove_tree(dir_); }

  const CarmenLog log_ = read_carmen_log(recording()).value();
  const std::string dir_ = dssm::test::make_temp_dir();
  const std::string map_ = dir_ + "/map.png";

  std::vector<ScanReading> scans() const {
    std::vector<ScanReading> result;
    std::copy_if(log_.scans.begin(), log_.scans.end(), std::back_inserter(result),
                 [](const ScanReading& scan) { return scan.time_s <= kToS; });
    return result;
  }
};

TEST_F(VehicleDrive, GivesEachScanAPoseAndTheSameMapInAnyStartOrder) {
  const unsigned seed = std::random_device()();
  SCOPED_TRACE("seed " + std::to_string(seed));
  std::mt19937 random(seed);
  std::vector<Command> commands{source("encoder"), source("lidar"), localizer(), mapper(map_)};
  std::string first_map;
  for (int round = 0; round < 2; ++round) {
    std::shuffle(commands.begin(), commands.end(), random);
    const DaemonProcess daemon;
    run_all(daemon, commands);
    const auto end_mark = 1;
    EXPECT_EQ(written(daemon, "lidar"), std::ssize(scans()) + end_mark);
    EXPECT_EQ(written(daemon, "pose"), std::ssize(scans()) + end_mark);
    const std::string map = content(map_);
    EXPECT_FALSE(map.empty());
    if (round == 0) first_map = map;
    EXPECT_EQ(map, first_map) << "two runs gave two maps";
  }
}

TEST_F(VehicleDrive, GivesTheSameMapWhenTheReadersStartAfterTheDrive) {
  const DaemonProcess daemon;
  run_all(daemon, {source("encoder"), source("lidar")});
  run_all(daemon, {localizer()});
  run_all(daemon, {mapper(map_)});
  EXPECT_EQ(written(daemon, "pose"), std::ssize(scans()) + 1);

  // The streams carry exactly the recording: computed here without streams, the map is the same,
  // byte for byte.
  const std::vector<OdometryReading> odometry = resample(log_.odometry, kEncoderCycleS);
  OccupancyGrid grid;
  std::vector<Pose2> way;
  const auto ns = [](double s) { return static_cast<std::int64_t>(std::llround(s * 1e9)); };
  for (const ScanReading& scan : scans()) {
    const auto after = std::find_if(odometry.begin(), odometry.end(), [&](const auto& reading) {
      return ns(reading.time_s) > ns(scan.time_s);
    });
    ASSERT_TRUE(after != odometry.begin() && after != odometry.end());
    const auto before = after - 1;
    way.push_back(interpolate(before->pose, after->pose,
                              weight_of(ns(scan.time_s), ns(before->time_s), ns(after->time_s))));
    grid.add(way.back(), {scan.ranges_m, static_cast<float>(-M_PI / 2),
                          static_cast<float>(M_PI / static_cast<double>(scan.ranges_m.size()))});
  }
  ASSERT_TRUE(write_png(draw_map(grid, way), dir_ + "/expected.png"));
  EXPECT_EQ(content(map_), content(dir_ + "/expected.png"));
}

TEST_F(VehicleDrive, GivesTheSameMapEachTimeItIsReplayedInLockstep) {
  const std::string dssmctl = dssm::test::built("client/dssmctl/dssmctl");
  const std::string drive = dir_ + "/drive.mcap", again = dir_ + "/again.png";
  {
    const DaemonProcess daemon;
    const pid_t recorder = dssm::test::start({dssmctl, "record", "odometry", "lidar", "-o", drive},
                                             {daemon.environment()});
    run_all(daemon, {source("encoder"), source("lidar"), localizer(), mapper(map_)});
    // It has the past, too, of streams that it finds.
    dssm::Session session = connect(daemon);
    for (const char* name : {"odometry", "lidar"}) {
      dssm::test::await([&] {
        return session.stream_info(dssm::StreamId{name, 0, ""}).value().readers == 1;
      });
    }
    ::kill(recorder, SIGINT);
    EXPECT_EQ(dssm::test::wait_for(recorder), 0);
  }
  for (int round = 0; round < 2; ++round) {
    const DaemonProcess daemon;
    const std::string mapping = program("mapper", {}).front() + " --out " + again;
    const dssm::test::Finished played =
        dssm::test::run({dssmctl, "play", drive, "--lockstep", program("localizer", {}).front(),
                         "--lockstep", mapping},
                        {daemon.environment()});
    ASSERT_EQ(played.exit_status, 0) << played.err;
    EXPECT_EQ(written(daemon, "pose"), std::ssize(scans()) + 1);
    EXPECT_EQ(content(again), content(map_)) << "round " << round;
    dssm::test::remove_tree(again);
  }
}

TEST_F(VehicleDrive, DrawsAPictureWithWallsFloorAndPath) {
  const DaemonProcess daemon;
  run_all(daemon, {source("encoder"), source("lidar"), localizer(), mapper(map_)});
  png_image image{};
  image.version = PNG_IMAGE_VERSION;
  ASSERT_TRUE(png_image_begin_read_from_file(&image, map_.c_str()));
  image.format = PNG_FORMAT_RGB;
  std::vector<png_byte> rgb(PNG_IMAGE_SIZE(image));
  ASSERT_TRUE(png_image_finish_read(&image, nullptr, rgb.data(), 0, nullptr));
  std::size_t dark = 0, white = 0, blue = 0;
  for (std::size_t i = 0; i + 2 < rgb.size(); i += 3) {
    const int colour = (rgb[i] << 16) + (rgb[i + 1] << 8) + rgb[i + 2];
    dark += colour == 0x191c24;
    white += colour == 0xffffff;
    blue += colour == 0x266edc;
  }
  // Four pixels per cell of 25 cm2. In its first minute the vehicle sees about 30 m of corridor:
  // some 100 m of wall, a cell or two thick, around 50 to 150 m2 of floor.
  EXPECT_GT(dark, 4 * 1500u);
  EXPECT_LT(dark, 4 * 15000u);
  EXPECT_GT(white, 4 * 50 * 400u);
  EXPECT_LT(white, 4 * 300 * 400u);
  EXPECT_GT(blue, 500u);
}

TEST_F(VehicleDrive, EndsCleanlyWithAMapWhenTheLidarIsInterrupted) {
  const DaemonProcess daemon;
  const Command endless{"--speed", "1"};  // would take a minute
  const pid_t encoder = dssm::test::start(source("encoder", endless), {daemon.environment()});
  const pid_t lidar = dssm::test::start(source("lidar", endless), {daemon.environment()});
  const pid_t localizing =
      dssm::test::start(program("localizer", {"--late"}), {daemon.environment()});
  const pid_t mapping = dssm::test::start(mapper(map_), {daemon.environment()});

  dssm::Session session = connect(daemon);
  dssm::RawReader poses =
      session.await_raw_reader(dssm::StreamId{"pose", 0, ""}, dssm::kNever).value();
  ASSERT_EQ(poses.wait_for_tid(2, dssm::kNever), dssm::WaitStatus::ready);
  ::kill(lidar, SIGINT);
  EXPECT_EQ(dssm::test::wait_for(lidar), 0);
  EXPECT_EQ(dssm::test::wait_for(localizing), 0);  // by the lidar's end mark
  EXPECT_EQ(dssm::test::wait_for(mapping), 0);     // by the localizer's
  ::kill(encoder, SIGTERM);
  EXPECT_EQ(dssm::test::wait_for(encoder), 0);
  EXPECT_FALSE(content(map_).empty());
}

TEST_F(VehicleDrive, SkipsADriveThatIsOverAndMapsTheNextOne) {
  const DaemonProcess daemon;
  run_all(daemon, {source("encoder"), source("lidar")});
  const dssm::Tid first_drive = written(daemon, "lidar");
  const pid_t localizing =
      dssm::test::start(program("localizer", {"--deadline", "600"}), {daemon.environment()});
  // The localizer creates its stream after it has moved to its first scan.
  dssm::Session session = connect(daemon);
  (void)session.await_raw_reader(dssm::StreamId{"pose", 0, ""}, dssm::kNever).value();
  run_all(daemon, {source("encoder"), source("lidar")});
  EXPECT_EQ(dssm::test::wait_for(localizing), 0);
  EXPECT_EQ(written(daemon, "lidar"), 2 * first_drive);
  EXPECT_EQ(written(daemon, "pose"), first_drive);
}

TEST_F(VehicleDrive, FailsWithAMessageWithoutADaemon) {
  for (const Command& command : {source("encoder"), source("lidar"), localizer(), mapper(map_)}) {
    const dssm::test::Finished finished =
        dssm::test::run(command, {"DSSM_SOCKET=" + dir_ + "/nobody.sock"});
    EXPECT_EQ(finished.exit_status, 1) << command[0];
    EXPECT_NE(finished.err.find("dssmd"), std::string::npos) << command[0] << finished.err;
  }
}

TEST_F(VehicleDrive, RefusesInvalidOptions) {
  const struct {
    Command arguments;
    std::string expected;
  } cases[] = {
      {{"--log", "/nowhere.log"}, "'/nowhere.log'"},
      {{"--log", recording(), "--from", "9", "--to", "3"}, "--to must be later"},
      {{"--log", recording(), "--stamps", "now"}, "--start-at"},
  };
  const DaemonProcess daemon;
  for (const auto& one : cases) {
    for (const char* name : {"encoder", "lidar"}) {
      const dssm::test::Finished finished =
          dssm::test::run(program(name, one.arguments), {daemon.environment()});
      EXPECT_EQ(finished.exit_status, 1) << name;
      EXPECT_NE(finished.err.find(one.expected), std::string::npos) << name << finished.err;
    }
  }
}

}  // namespace
}  // namespace vehicle
