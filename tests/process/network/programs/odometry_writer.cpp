// SPDX-License-Identifier: Apache-2.0
//
// A typical sensor handler for SSM. It prints "running" after 1000 samples, and writes until the
// file `stop` exists in its folder.
#include <ssm.hpp>
#include <string>

#include "odometry.h"
#include "tests/process/ssm/programs/check.h"

int main(int argc, char** argv) {
  check_begin(argc, argv);
  const std::string stop = std::string(check_folder) + "/stop";
  SSMApi<Odometry, OdometryProperty> odometry(ODOMETRY_NAME, 0);
  CHECK_EQUAL(initSSM(), 1);
  CHECK(odometry.create(100.0, ODOMETRY_CYCLE));
  odometry.property.wheel_radius = 0.125;
  strcpy(odometry.property.maker, "T-frog");
  CHECK(odometry.setProperty());
  for (int number = 0; check_failures == 0 && access(stop.c_str(), F_OK) != 0; ++number) {
    odometry.data.x = number;
    odometry.data.y = -number;
    odometry.data.theta = 0.5 * number;
    odometry.data.number = number;
    CHECK(odometry.write(ODOMETRY_START + number * ODOMETRY_CYCLE));
    if (number == 999) puts("running");
    if (number > 999) usleepSSM(1000);
  }
  CHECK_EQUAL(endSSM(), 1);
  return check_result();
}
