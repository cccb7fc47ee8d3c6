// SPDX-License-Identifier: Apache-2.0
//
// Loops of an SSM program over a stream that another program removes and recreates. It prints the
// number up to which it has read everything, and reads from stdin which one to await next.
#include <libssm.h>

#include <ssm.hpp>

#include "recreated.h"

int main(int argc, char** argv) {
  check_begin(argc, argv);
  CHECK(initSSM());
  SSMApi<int> next("recreated", 0), newest("recreated", 0), by_time("recreated", 0);
  CHECK(next.open() && newest.open() && by_time.open());
  next.timeId = 0;  // the first sample is a start for all
  SSM_tid last_new = -1, last_next = 0;
  int awaited = 0;
  while (scanf("%d", &awaited) == 1) {
    read_next_until(next, awaited, last_next, read_next);
    read_new_until(newest, awaited, last_new);
    CHECK_EQUAL(getTID_top(newest.getSSMId()), newest.timeId);
    CHECK(getTID_bottom(newest.getSSMId()) <= newest.timeId);
    CHECK_EQUAL(waitTID(newest.getSSMId(), newest.timeId), 1);
    while (!by_time.readTime(0) || by_time.data != awaited) usleep(1000);
    CHECK(by_time.read(by_time.timeId) && by_time.data == awaited);
    printf("%d\n", awaited);
  }
  CHECK(endSSM());
  return check_result();
}
