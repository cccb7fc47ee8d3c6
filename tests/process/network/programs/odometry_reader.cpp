// SPDX-License-Identifier: Apache-2.0
//
// A typical SSM program that reads odometry by time, in order, and newest first. It names the
// stream, but no PC.
#include <ssm.hpp>

#include "odometry.h"
#include "tests/process/ssm/programs/check.h"

static double time_of(int number) { return ODOMETRY_START + number * ODOMETRY_CYCLE; }

// The last read returned sample `number`, untorn.
static void check_sample(const SSMApi<Odometry, OdometryProperty>& odometry, int number) {
  CHECK_EQUAL(odometry.timeId, number);
  CHECK_EQUAL(odometry.data.number, number);
  CHECK_SAME(odometry.data.x, number);
  CHECK_SAME(odometry.data.y, -number);
  CHECK_SAME(odometry.data.theta, 0.5 * number);
  CHECK(odometry.time > time_of(number) - 0.001 && odometry.time < time_of(number) + 0.001);
}

// Waits for the next sample without a limit; readNext() waits for a second.
static void next(SSMApi<Odometry, OdometryProperty>& odometry) {
  double before = gettimeSSM_real();
  while (!odometry.readNext()) {
    const double now = gettimeSSM_real();
    CHECK(now - before > 0.9);
    before = now;
  }
}

int main(int argc, char** argv) {
  check_begin(argc, argv);
  SSMApi<Odometry, OdometryProperty> odometry(ODOMETRY_NAME, 0);
  CHECK_EQUAL(initSSM(), 1);
  odometry.setVerbose(false);
  CHECK(odometry.openWait());
  CHECK(odometry.getProperty());
  CHECK_SAME(odometry.property.wheel_radius, 0.125);
  CHECK(strcmp(odometry.property.maker, "T-frog") == 0);

  // Samples from before this program was started.
  for (int number = 0; number < 1000; ++number) {
    CHECK(odometry.readTime(time_of(number) + 0.5 * ODOMETRY_CYCLE));
    check_sample(odometry, number);
  }
  CHECK(!odometry.readTime(ODOMETRY_START - 1));
  CHECK(odometry.read(7));
  check_sample(odometry, 7);
  CHECK(odometry.readBack(3));
  check_sample(odometry, 4);

  // New samples, one by one.
  odometry.setBlocking(true);
  CHECK(odometry.readLast());
  const int first = odometry.timeId;
  CHECK(first >= 999);
  for (int number = first + 1; number < first + 500; ++number) {
    next(odometry);
    check_sample(odometry, number);
  }
  CHECK_EQUAL(endSSM(), 1);
  return check_result();
}
