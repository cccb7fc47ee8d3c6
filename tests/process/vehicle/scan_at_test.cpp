// SPDX-License-Identifier: Apache-2.0
//
// Tests finding the scan of a pose, with a real stream.
#include "docs/examples/vehicle/scan_at.hpp"

#include <gtest/gtest.h>

#include <chrono>
#include <dssm/dssm.hpp>
#include <thread>

#include "docs/examples/vehicle/stop.hpp"
#include "tests/process/vehicle/drive.hpp"

namespace vehicle {
namespace {

using std::chrono::milliseconds;

class ScanAtTest : public testing::Test {
 protected:
  dssm::test::DaemonProcess daemon_;
  dssm::Session session_ = test::connect(daemon_);
  dssm::Writer<Scan> lidar_ =
      session_.create<Scan>(kScanStream, dssm::History{8, milliseconds(100)}).value();
  Scan scan_{};

  ScanAt scans(dssm::Duration deadline = std::chrono::minutes(1)) {
    return ScanAt(session_.open_reader<Scan>(kScanStream).value(), deadline);
  }
  // Each scan has another number of beams.
  void write(std::int32_t beams, std::int64_t at_ms) {
    Scan scan{};
    scan.beams = beams;
    lidar_.write(scan, dssm::Time(milliseconds(at_ms)));
  }
  static dssm::Time at_ms(std::int64_t ms) { return dssm::Time(milliseconds(ms)); }
};

TEST_F(ScanAtTest, ReturnsTheScanOfTheTime) {
  for (int i = 0; i < 5; ++i) write(10 + i, 1000 + 100 * i);
  ASSERT_TRUE(scans().at(at_ms(1200), 2, scan_));
  EXPECT_EQ(scan_.beams, 12);
}

TEST_F(ScanAtTest, WaitsForAScanThatArrivesAfterItsPose) {
  write(10, 1000);
  ScanAt scans = this->scans();
  std::thread late([&] { write(11, 1100); });
  const bool found = scans.at(at_ms(1100), 1, scan_);
  late.join();
  ASSERT_TRUE(found);
  EXPECT_EQ(scan_.beams, 11);
}

TEST_F(ScanAtTest, WaitsForTheFirstScan) {
  ScanAt scans = this->scans();
  std::thread late([&] { write(10, 1000); });
  const bool found = scans.at(at_ms(1000), 0, scan_);
  late.join();
  ASSERT_TRUE(found);
  EXPECT_EQ(scan_.beams, 10);
}

TEST_F(ScanAtTest, FailsAtTheDeadlineWithoutTheScan) {
  write(10, 1000);
  EXPECT_FALSE(scans(milliseconds(1)).at(at_ms(1100), 1, scan_));
}

TEST_F(ScanAtTest, FailsAtOnceWhenTheRingNoLongerHoldsTheScan) {
  for (int i = 0; i < 20; ++i) write(10, 1000 + 100 * i);
  EXPECT_FALSE(scans(std::chrono::hours(1)).at(at_ms(1100), 1, scan_));
}

TEST_F(ScanAtTest, DoesNotReturnAScanOfAnotherDrive) {
  for (int drive = 0; drive < 2; ++drive) {
    for (int i = 0; i < 3; ++i) write(10 * (drive + 1) + i, 1000 + 100 * i);
  }
  ScanAt scans = this->scans(std::chrono::hours(1));
  EXPECT_FALSE(scans.at(at_ms(1100), 1, scan_));
  ASSERT_TRUE(scans.at(at_ms(1100), 4, scan_));
  EXPECT_EQ(scan_.beams, 21);
}

TEST_F(ScanAtTest, ContinuesWhenTheStreamIsRecreated) {
  for (int i = 0; i < 5; ++i) write(10 + i, 1000 + 100 * i);
  ScanAt scans = this->scans(std::chrono::hours(1));
  ASSERT_TRUE(scans.at(at_ms(1400), 4, scan_));
  ASSERT_TRUE(session_.remove(dssm::StreamId{kScanStream, 0, ""}));
  lidar_ = session_.create<Scan>(kScanStream, dssm::History{8, milliseconds(100)}).value();
  for (int i = 0; i < 7; ++i) write(20 + i, 5000 + 100 * i);
  ASSERT_TRUE(scans.at(at_ms(5600), 6, scan_));
  EXPECT_EQ(scan_.beams, 26);
}

TEST_F(ScanAtTest, EndsAfterASignalToStop) {
  ScanAt scans = this->scans(std::chrono::hours(1));
  stop_signal = SIGINT;
  EXPECT_FALSE(scans.at(at_ms(1000), 0, scan_));
  stop_signal = 0;
}

}  // namespace
}  // namespace vehicle
