// SPDX-License-Identifier: Apache-2.0
//
// A logger as programs for SSM have it, unedited: records a stream of robot positions until Ctrl-C,
// and prints a line for each record. Arguments: LOG.
#include <signal.h>

#include <iostream>
#include <ssm-log.hpp>
#include <ssm.hpp>

using namespace std;

#define SNAME_ODOMETRY "spur_odometry"

typedef struct {
  double x;
  double y;
  double theta;
  double v;
  double w;
} Spur_Odometry;

typedef struct {
  double radius_r;
  double radius_l;
  double tread;
} Spur_Odometry_Property;

bool gShutOff = false;

void ctrlC(int) { gShutOff = true; }

int main(int argc, char** argv) {
  if (argc != 2) return 1;
  signal(SIGINT, ctrlC);
  if (!initSSM()) return 1;
  SSMApi<Spur_Odometry, Spur_Odometry_Property> odometry(SNAME_ODOMETRY, 3);
  SSMLog<Spur_Odometry, Spur_Odometry_Property> log;
  if (!odometry.openWait(60.0)) return 1;
  if (!odometry.getProperty()) return 1;
  size_t size, propertySize;
  int num;
  double cycle;
  if (getSSM_info(SNAME_ODOMETRY, 3, &size, &num, &cycle, &propertySize) < 0) return 1;
  log.property() = odometry.property;
  if (!log.create(SNAME_ODOMETRY, 3, num, cycle, argv[1])) return 1;
  odometry.setBlocking(true);
  cout << "start" << endl;
  while (!gShutOff) {
    if (!odometry.readNext()) continue;
    log.data() = odometry.data;
    log.write(odometry.time);
    cout << odometry.timeId << endl;
  }
  log.close();
  odometry.close();
  endSSM();
  return 0;
}
