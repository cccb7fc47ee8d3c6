// SPDX-License-Identifier: Apache-2.0
//
// Tests the parser with valid lines, with invalid lines, and with the whole recording.
#include "docs/examples/vehicle/carmen_log.hpp"

#include <gtest/gtest.h>
#include <zlib.h>

#include <algorithm>
#include <cmath>
#include <cstdlib>
#include <fstream>
#include <string>

#include "docs/examples/vehicle/samples.hpp"
#include "tests/support/daemon_process.hpp"

namespace vehicle {
namespace {

std::string odom(const std::string& stamp, double x = 0) {
  return "ODOM " + std::to_string(x) + " 0 0 0 0 0 " + stamp + " pippo " + stamp + "\n";
}
std::string flaser(const std::string& stamp) {
  return "FLASER 2 1.5 81.91 4 5 6 7 8 9 " + stamp + " pippo " + stamp + "\n";
}
std::vector<double> times(const std::vector<OdometryReading>& readings) {
  std::vector<double> result;
  for (const OdometryReading& reading : readings) result.push_back(reading.time_s);
  return result;
}

std::string recording() {
  return std::string(std::getenv("DSSM_SOURCE_ROOT")) +
         "/docs/examples/vehicle/data/freiburg-079.carmen.log.gz";
}

TEST(CarmenLog, ReadsEveryFieldThatTheVehicleUses) {
  const CarmenLog log = parse_carmen_log(
      "ODOM 1.5 -2 0.25 0.1 0.2 0.3 12.5 pippo 12.5\n"
      "FLASER 3 1 2.5 81.91 4 5 6 7 8 9 12.75 pippo 12.75\n");
  ASSERT_EQ(log.odometry.size(), 1u);
  EXPECT_EQ(log.odometry[0].time_s, 12.5);
  EXPECT_EQ(log.odometry[0].pose.x_m, 1.5);
  EXPECT_EQ(log.odometry[0].pose.y_m, -2);
  EXPECT_EQ(log.odometry[0].pose.theta_rad, 0.25);
  ASSERT_EQ(log.scans.size(), 1u);
  EXPECT_EQ(log.scans[0].time_s, 12.75);
  EXPECT_EQ(log.scans[0].ranges_m, (std::vector<float>{1, 2.5, INFINITY}));
  EXPECT_EQ(log.scans[0].laser.x_m, 4);
  EXPECT_EQ(log.scans[0].laser.y_m, 5);
  EXPECT_EQ(log.scans[0].laser.theta_rad, 6);
  EXPECT_EQ(log.skipped.bad, 0u);
}

TEST(CarmenLog, SkipsOtherLinesWithoutCountingThemAsBad) {
  const CarmenLog log = parse_carmen_log(
      "# message formats defined: PARAM SYNC ODOM FLASER RLASER\n#\n\nPARAM robot_use_laser on 1 m "
      "1\n"
      "NEFF 6.4\n  \r\n" +
      odom("1"));
  EXPECT_EQ(log.odometry.size(), 1u);
  EXPECT_EQ(log.skipped.bad, 0u);
}

TEST(CarmenLog, SkipsOdometryWithoutTimestamp) {
  const CarmenLog log = parse_carmen_log(odom("1", 10) + odom("0", 20) + odom("1.2", 30));
  ASSERT_EQ(log.odometry.size(), 2u);
  EXPECT_EQ(log.odometry[1].pose.x_m, 30);
  EXPECT_EQ(log.skipped.unstamped, 1u);
  EXPECT_EQ(log.skipped.misstamped, 0u);
}

TEST(CarmenLog, SortsSlightlyUnorderedLines) {
  const CarmenLog log =
      parse_carmen_log(odom("-0.3") + odom("0.2") + flaser("0.9") + odom("0.6") + odom("0.4"));
  EXPECT_EQ(times(log.odometry), (std::vector<double>{-0.3, 0.2, 0.4, 0.6}));
  EXPECT_EQ(log.skipped.misstamped, 0u);
}

TEST(CarmenLog, KeepsFileOrderAmongEqualTimes) {
  const CarmenLog log = parse_carmen_log(odom("1", 1) + odom("1", 2) + odom("1", 3));
  ASSERT_EQ(log.odometry.size(), 3u);
  for (std::size_t i = 0; i < 3; ++i) {
    EXPECT_EQ(log.odometry[i].pose.x_m, static_cast<double>(i) + 1);
  }
}

TEST(CarmenLog, SkipsStampsFarFromTheSurroundingOnes) {
  std::string text;
  for (int i = 0; i < 20; ++i) text += flaser(std::to_string(1000 + i * 0.2));
  text += odom("8.97771e-67") + flaser("1004") + odom("-0.95") + flaser("1004.2") + odom("9e12") +
          flaser("1004.4") + odom("1004.3") + flaser("1004.6");
  const CarmenLog log = parse_carmen_log(text);
  EXPECT_EQ(times(log.odometry), std::vector<double>{1004.3});
  EXPECT_EQ(log.scans.size(), 24u);
  EXPECT_EQ(log.skipped.misstamped, 3u);
}

TEST(CarmenLog, KeepsBothSidesOfAPause) {
  std::string text;
  for (int i = 0; i < 10; ++i) text += odom(std::to_string(1 + i * 0.2));
  for (int i = 0; i < 10; ++i) text += odom(std::to_string(500 + i * 0.2));
  const CarmenLog log = parse_carmen_log(text);
  EXPECT_EQ(log.odometry.size(), 20u);
  EXPECT_EQ(log.skipped.misstamped, 0u);
}

TEST(CarmenLog, CountsUnreadableLinesAndReportsTheFirst) {
  const std::string bad[] = {
      "ODOM 1 2 3 0 0 0",                // torn
      "ODOM 1 2 three 0 0 0 5 pippo 5",  // not a number
      "ODOM 1 nan 3 0 0 0 5 pippo 5",    // not finite
      "ODOM 1 1e999 3 0 0 0 5 pippo 5",  // does not fit into a double
      "FLASER 3 1 2 4 5 6",              // fewer ranges than announced
      "FLASER 0 4 5 6 7 8 9 1 pippo 1",  // no beams
      "FLASER -1 4 5 6 7 8 9 1 pippo 1",
      "FLASER 1.5 1 4 5 6 7 8 9 1 pippo 1",
      "FLASER 4000000000 1 4 5 6 7 8 9 1 pippo 1",  // more than memory
      "FLASER 1 -2 4 5 6 7 8 9 1 pippo 1",          // negative range
      "ODO",
      std::string("\0\xff\x80", 3),
  };
  std::string text = odom("4");
  for (const std::string& line : bad) text += line + "\n";
  text += odom("5");
  text += "ODOM 1 2 3 0 0";  // the file ends inside a line
  const CarmenLog log = parse_carmen_log(text);
  EXPECT_EQ(times(log.odometry), (std::vector<double>{4, 5}));
  EXPECT_TRUE(log.scans.empty());
  EXPECT_EQ(log.skipped.bad, std::size(bad) + 1);
  EXPECT_EQ(log.skipped.first_bad, "line 2: 'ODOM 1 2 3 0 0 0'");
  EXPECT_NE(log.summary().find("13 unreadable"), std::string::npos) << log.summary();
}

TEST(CarmenLog, AcceptsTheLargestScanAndRefusesALargerOne) {
  const auto scan_of = [](std::size_t beams) {
    std::string line = "FLASER " + std::to_string(beams);
    for (std::size_t i = 0; i < beams; ++i) line += " 1";
    return line + " 4 5 6 7 8 9 1 pippo 1\n";
  };
  const CarmenLog log = parse_carmen_log(scan_of(kMaxBeams) + scan_of(kMaxBeams + 1));
  EXPECT_EQ(log.scans.size(), 1u);
  EXPECT_EQ(log.skipped.bad, 1u);
}

TEST(CarmenLog, GivesAnEmptyLogForAnEmptyText) {
  const CarmenLog log = parse_carmen_log("");
  EXPECT_TRUE(log.odometry.empty());
  EXPECT_TRUE(log.scans.empty());
}

TEST(CarmenLog, ReadsTheWholeRecording) {
  const dssm::Result<CarmenLog> log = read_carmen_log(recording());
  ASSERT_TRUE(log) << log.error().message;
  EXPECT_EQ(log->scans.size(), 4791u);
  EXPECT_EQ(log->odometry.size() + log->skipped.unstamped + log->skipped.misstamped, 9725u);
  EXPECT_EQ(log->skipped.unstamped, 4772u);
  EXPECT_EQ(log->skipped.misstamped, 19u);
  EXPECT_EQ(log->skipped.bad, 0u);
  EXPECT_TRUE(std::all_of(log->scans.begin(), log->scans.end(),
                          [](const ScanReading& scan) { return scan.ranges_m.size() == 360; }));
  EXPECT_EQ(log->scans.front().time_s, 0.227623);
  EXPECT_EQ(log->odometry.back().time_s, 1061.5);
}

TEST(CarmenLog, ReadsPlainTextLikeCompressed) {
  const std::string dir = dssm::test::make_temp_dir();
  std::ofstream(dir + "/plain.log") << odom("1") << flaser("1.1");
  const dssm::Result<CarmenLog> log = read_carmen_log(dir + "/plain.log");
  ASSERT_TRUE(log) << log.error().message;
  EXPECT_EQ(log->odometry.size(), 1u);
  EXPECT_EQ(log->scans.size(), 1u);
  dssm::test::remove_tree(dir);
}

TEST(CarmenLog, FailsWithTheNameOfAMissingFile) {
  const dssm::Result<CarmenLog> log = read_carmen_log("/nowhere/drive.log");
  ASSERT_FALSE(log);
  EXPECT_EQ(log.error().code, dssm::Errc::not_found);
  EXPECT_NE(log.error().message.find("'/nowhere/drive.log'"), std::string::npos);
}

TEST(CarmenLog, RefusesATruncatedArchiveAndAFileWithoutUsableLines) {
  const std::string dir = dssm::test::make_temp_dir();
  std::ifstream whole(recording(), std::ios::binary);
  std::string head(100'000, '\0');
  whole.read(head.data(), static_cast<std::streamsize>(head.size()));
  std::ofstream(dir + "/torn.log.gz", std::ios::binary) << head;
  const dssm::Result<CarmenLog> torn = read_carmen_log(dir + "/torn.log.gz");
  ASSERT_FALSE(torn);
  EXPECT_NE(torn.error().message.find("damaged"), std::string::npos) << torn.error().message;

  std::ofstream(dir + "/letter.txt") << "Dear reader,\nthis is no recording.\n";
  const dssm::Result<CarmenLog> letter = read_carmen_log(dir + "/letter.txt");
  ASSERT_FALSE(letter);
  EXPECT_EQ(letter.error().code, dssm::Errc::invalid_argument);
  dssm::test::remove_tree(dir);
}

TEST(Scan, LimitsItsRangesForAnyNumberOfBeams) {
  Scan scan{};
  scan.beams = 3;
  EXPECT_EQ(scan.ranges().size(), 3u);
  scan.beams = 2'000'000'000;
  EXPECT_EQ(scan.ranges().size(), kMaxBeams);
  scan.beams = -5;
  EXPECT_TRUE(scan.ranges().empty());
}

}  // namespace
}  // namespace vehicle
