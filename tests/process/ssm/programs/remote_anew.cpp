// SPDX-License-Identifier: Apache-2.0
//
// Loops of a program for the old DSSM while the other PC's dssmd is killed and comes back, and
// while the stream is created anew there. Says on stdout when it has read all up to a number, and
// is told on stdin what to await next. To the program tids keep rising. Arguments: FOLDER ADDRESS.
#include "check.h"
#include "dssm.hpp"

int main(int argc, char** argv) {
  check_begin(argc, argv);
  DSSMApi<int> next("anew", 0, argv[2]), newest("anew", 0, argv[2]), buffered("anew", 0, argv[2]);
  DSSMApi<int>* const all[] = {&next, &newest, &buffered};
  for (int i = 0; i < 3; ++i) {
    CHECK(all[i]->initRemote() && all[i]->open(SSM_READ_BUFFER) && all[i]->createDataCon());
  }
  buffered.readyRingBuf(1000, 1);
  next.timeId = 0;  // the first sample is a start for all
  buffered.timeId = 0;
  SSM_tid last_new = -1, last_next = 0, last_buffered = 0;
  int awaited = 0;
  while (scanf("%d", &awaited) == 1) {
    while (next.data != awaited || next.timeId < 1) {
      if (!next.readNext()) {
        usleep(1000);
        continue;
      }
      CHECK_EQUAL(next.timeId, last_next + 1);
      last_next = next.timeId;
    }
    while (newest.data != awaited || newest.timeId < 0) {
      if (!newest.readNew()) {
        usleep(1000);
        continue;
      }
      CHECK(newest.timeId > last_new);
      last_new = newest.timeId;
    }
    CHECK_EQUAL(newest.getTID_top(), newest.timeId);
    CHECK(newest.getTID_bottom() <= newest.timeId);
    CHECK(!newest.isUpdate() && !newest.readNew());
    CHECK(newest.read(newest.timeId) && newest.data == awaited);
    while (buffered.data != awaited || buffered.timeId < 1) {
      if (!buffered.readNextBuf()) {
        usleep(1000);
        continue;
      }
      CHECK_EQUAL(buffered.timeId, last_buffered + 1);
      last_buffered = buffered.timeId;
    }
    CHECK(buffered.readTimeBuf(0) && buffered.data == awaited);
    printf("%d\n", awaited);
  }
  return check_result();
}
