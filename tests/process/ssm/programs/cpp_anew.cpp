// SPDX-License-Identifier: Apache-2.0
//
// Loops of an SSM program over a stream that is removed and created anew by somebody else. Says on
// stdout when it has read all up to a number, and is told on stdin what to await next. To the
// program tids keep rising.
#include <libssm.h>

#include <ssm.hpp>

#include "check.h"

int main(int argc, char** argv) {
  check_begin(argc, argv);
  CHECK(initSSM());
  SSMApi<int> next("anew", 0), newest("anew", 0), by_time("anew", 0);
  CHECK(next.open() && newest.open() && by_time.open());
  next.timeId = 0;  // the first sample is a start for all
  SSM_tid last_new = -1, last_next = 0;
  int awaited = 0;
  while (scanf("%d", &awaited) == 1) {
    // readNext: one after the other, nothing left out.
    while (next.data != awaited || next.timeId < 1) {
      if (!next.readNext()) {
        usleep(1000);
        continue;
      }
      CHECK_EQUAL(next.timeId, last_next + 1);
      last_next = next.timeId;
    }
    // readNew: newer each time.
    while (newest.data != awaited || newest.timeId < 0) {
      if (!newest.readNew()) {
        usleep(1000);
        continue;
      }
      CHECK(newest.timeId > last_new);
      last_new = newest.timeId;
    }
    CHECK_EQUAL(getTID_top(newest.getSSMId()), newest.timeId);
    CHECK(getTID_bottom(newest.getSSMId()) <= newest.timeId);
    CHECK(!newest.isUpdate() && !newest.readNew());
    CHECK_EQUAL(waitTID(newest.getSSMId(), newest.timeId), 1);
    while (!by_time.readTime(0) || by_time.data != awaited) usleep(1000);
    CHECK(by_time.read(by_time.timeId) && by_time.data == awaited);
    printf("%d\n", awaited);
  }
  CHECK(endSSM());
  return check_result();
}
