// SPDX-License-Identifier: Apache-2.0
//
// The payload of the stream "odometry". A plain struct, as usual in SSM programs: the encoder
// writes it through <ssm.hpp>, the localizer reads it through <dssm/...>.
#pragma once

struct Odometry {
  double x_m, y_m;   // in the recording's frame, whose origin is the start of the drive
  double theta_rad;  // counter-clockwise from x
};
