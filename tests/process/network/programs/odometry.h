/* SPDX-License-Identifier: Apache-2.0 */
#ifndef TESTS_NETWORK_ODOMETRY_H
#define TESTS_NETWORK_ODOMETRY_H

#define ODOMETRY_NAME "odometry"
#define ODOMETRY_START 1000.0 /* time of the first sample */
#define ODOMETRY_CYCLE 0.01

typedef struct {
  double x, y, theta;
  int number;
} Odometry;

typedef struct {
  double wheel_radius;
  char maker[20];
} OdometryProperty;

#endif
