// SPDX-License-Identifier: Apache-2.0
//
// Loops of a program for the old DSSM while the other PC's dssmd is killed and restarted, and while
// the stream is recreated there. It prints the number up to which it has read everything, and reads
// from stdin which one to await next. Arguments: FOLDER ADDRESS.
#include "dssm.hpp"
#include "recreated.h"

static bool read_next_buffered(DSSMApi<int>& api) { return api.readNextBuf(); }

int main(int argc, char** argv) {
  check_begin(argc, argv);
  const char* const name = "recreated";
  DSSMApi<int> next(name, 0, argv[2]), newest(name, 0, argv[2]), buffered(name, 0, argv[2]);
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
    read_next_until(next, awaited, last_next, read_next);
    read_new_until(newest, awaited, last_new);
    CHECK_EQUAL(newest.getTID_top(), newest.timeId);
    CHECK(newest.getTID_bottom() <= newest.timeId);
    CHECK(newest.read(newest.timeId) && newest.data == awaited);
    read_next_until(buffered, awaited, last_buffered, read_next_buffered);
    CHECK(buffered.readTimeBuf(0) && buffered.data == awaited);
    printf("%d\n", awaited);
  }
  return check_result();
}
