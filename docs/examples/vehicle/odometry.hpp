// SPDX-License-Identifier: Apache-2.0
//
// What the encoder writes to the stream "odometry". A plain struct, as SSM programs have them: the
// encoder writes it through <ssm.hpp>, the localizer reads it through <dssm/...>.
#pragma once

struct Odometry {
  double x_m, y_m;   // in the recording's frame: where the drive began
  double theta_rad;  // counter-clockwise from x
};
