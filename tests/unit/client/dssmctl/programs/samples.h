// SPDX-License-Identifier: Apache-2.0
//
// Types of samples of every kind, as C programs have them. The test compares what debug information
// says of them with what the compiler does.
#ifndef DSSM_TEST_SAMPLES_H
#define DSSM_TEST_SAMPLES_H

#include <stdbool.h>
#include <stdint.h>

typedef struct {
  double x;
  double y;
  double theta;
  double v;
  double w;
} Spur_Odometry;

typedef struct _pws_motor {
  int counter1;
  int counter2;
  int pwm1;
  int pwm2;
} PWSMotor;

enum Mode { kIdle, kDriving };
typedef struct {
  float position[3];
  unsigned char tag;
  short codes[2];
} Point;

struct Everything {
  char label[12];
  signed char s8;
  uint8_t u8;
  bool flag;
  int16_t s16;
  uint16_t u16;
  int32_t s32;
  uint32_t u32;
  const int64_t s64;
  volatile uint64_t u64;
  float f32;
  double f64;
  int grid[2][3];
  Point points[4];
  Point one_point;
  enum Mode mode;
  unsigned low : 3;
  unsigned high : 7;
  int negative : 5;
  bool bit : 1;
  uint64_t wide : 40;
  union {
    uint32_t as_integer;
    float as_float;
    uint8_t as_bytes[4];
  } value;
  union {  // anonymous
    int16_t first;
    uint16_t second;
  };
  void* next;
  long double precise;
};

struct __attribute__((packed)) Packed {
  uint8_t kind;
  double value;
  uint32_t low : 5;
  uint32_t across : 13;
  uint16_t end[2];
};

#endif
