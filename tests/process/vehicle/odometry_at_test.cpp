// SPDX-License-Identifier: Apache-2.0
//
// Tests reading the odometry at the time of a scan, with a real stream.
#include "docs/examples/vehicle/odometry_at.hpp"

#include <gtest/gtest.h>

#include <chrono>
#include <dssm/dssm.hpp>
#include <thread>

#include "docs/examples/vehicle/stop.hpp"
#include "tests/support/daemon_process.hpp"
#include "tests/support/session.hpp"

namespace vehicle {
namespace {

using std::chrono::milliseconds;

class OdometryAtTest : public testing::Test {
 protected:
  dssm::test::DaemonProcess daemon_;
  dssm::Session session_ = dssm::test::connect(daemon_);
  dssm::Writer<Odometry> encoder_ =
      session_.create<Odometry>("odometry", dssm::History{8, milliseconds(100)}).value();

  OdometryAt odometry(dssm::Duration deadline = std::chrono::minutes(1)) {
    return OdometryAt(session_.open_reader<Odometry>("odometry").value(), deadline);
  }
  static dssm::Time at_ms(std::int64_t ms) { return dssm::Time(milliseconds(ms)); }
};

TEST_F(OdometryAtTest, InterpolatesBetweenTheReadingsAroundTheTime) {
  encoder_.write({1, 10, 3.1}, at_ms(1000));
  encoder_.write({2, 14, -3.1}, at_ms(1100));
  const std::optional<Pose2> pose = odometry().at(at_ms(1025));
  ASSERT_TRUE(pose);
  EXPECT_DOUBLE_EQ(pose->x_m, 1.25);
  EXPECT_DOUBLE_EQ(pose->y_m, 11);
  // The shorter way, over pi, is 2 * pi - 6.2 = 0.0832 radians; a quarter of it is 0.0208.
  EXPECT_NEAR(pose->theta_rad, 3.12080, 5e-6);
}

TEST_F(OdometryAtTest, ReturnsAReadingOfTheExactTimeUnchanged) {
  encoder_.write({1, 10, 0.5}, at_ms(1000));
  encoder_.write({2, 14, 0.7}, at_ms(1100));
  encoder_.write({3, 18, 0.9}, at_ms(1200));
  const std::optional<Pose2> pose = odometry().at(at_ms(1100));
  ASSERT_TRUE(pose);
  EXPECT_EQ(pose->x_m, 2);
  EXPECT_EQ(pose->y_m, 14);
  EXPECT_EQ(pose->theta_rad, 0.7);
}

TEST_F(OdometryAtTest, WaitsForTheLaterReading) {
  encoder_.write({1, 0, 0}, at_ms(1000));
  OdometryAt odometry = this->odometry();
  std::thread late([&] { encoder_.write({2, 0, 0}, at_ms(1100)); });
  const std::optional<Pose2> pose = odometry.at(at_ms(1050));
  late.join();
  ASSERT_TRUE(pose);
  EXPECT_DOUBLE_EQ(pose->x_m, 1.5);
}

TEST_F(OdometryAtTest, WaitsForTheFirstReadings) {
  OdometryAt odometry = this->odometry();
  std::thread late([&] {
    encoder_.write({1, 0, 0}, at_ms(1000));
    encoder_.write({2, 0, 0}, at_ms(1100));
  });
  const std::optional<Pose2> pose = odometry.at(at_ms(1050));
  late.join();
  ASSERT_TRUE(pose);
  EXPECT_DOUBLE_EQ(pose->x_m, 1.5);
}

TEST_F(OdometryAtTest, IgnoresReadingsOfAnEarlierDrive) {
  encoder_.write({7, 7, 7}, at_ms(400'000));
  encoder_.write({8, 8, 8}, at_ms(400'100));
  OdometryAt odometry = this->odometry();
  std::thread next_drive([&] {
    encoder_.write({1, 0, 0}, at_ms(1000));
    encoder_.write({2, 0, 0}, at_ms(1100));
  });
  std::optional<Pose2> pose = odometry.at(at_ms(1050));
  next_drive.join();
  ASSERT_TRUE(pose);
  EXPECT_DOUBLE_EQ(pose->x_m, 1.5);
}

TEST_F(OdometryAtTest, FailsAtTheDeadlineWithoutALaterReading) {
  encoder_.write({1, 0, 0}, at_ms(1000));
  EXPECT_FALSE(odometry(milliseconds(1)).at(at_ms(1050)));
}

TEST_F(OdometryAtTest, FailsAtOnceWhenTheRingNoLongerHoldsTheTime) {
  OdometryAt odometry = this->odometry(std::chrono::hours(1));
  for (int i = 0; i < 20; ++i) encoder_.write({0, 0, 0}, at_ms(1000 + 100 * i));
  EXPECT_FALSE(odometry.at(at_ms(1050)));  // would wait an hour otherwise
}

TEST_F(OdometryAtTest, ContinuesWhenTheStreamIsRecreated) {
  encoder_.write({7, 7, 7}, at_ms(1000));
  encoder_.write({8, 8, 8}, at_ms(1100));
  OdometryAt odometry = this->odometry(std::chrono::hours(1));
  ASSERT_TRUE(odometry.at(at_ms(1050)));
  ASSERT_TRUE(session_.remove(dssm::StreamId{"odometry", 0, ""}));
  encoder_ = session_.create<Odometry>("odometry", dssm::History{8, milliseconds(100)}).value();
  encoder_.write({1, 0, 0}, at_ms(5000));
  encoder_.write({2, 0, 0}, at_ms(5100));
  const std::optional<Pose2> pose = odometry.at(at_ms(5050));
  ASSERT_TRUE(pose);
  EXPECT_DOUBLE_EQ(pose->x_m, 1.5);
}

TEST_F(OdometryAtTest, EndsAfterASignalToStop) {
  OdometryAt odometry = this->odometry(std::chrono::hours(1));
  stop_signal = SIGINT;
  EXPECT_FALSE(odometry.at(at_ms(1050)));
  stop_signal = 0;
}

}  // namespace
}  // namespace vehicle
