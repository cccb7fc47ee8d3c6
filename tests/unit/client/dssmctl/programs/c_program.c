// SPDX-License-Identifier: Apache-2.0
#include "samples.h"

Spur_Odometry odometry;
PWSMotor motor;
struct Everything everything;
struct Packed packed;
typedef struct {
  double left, right;
} Wheels;
typedef struct {
  double front, back;
} Bumpers;
Wheels wheels;
Bumpers bumpers;
