// SPDX-License-Identifier: Apache-2.0
//
// A program that writes and reads while its dssmd is killed and started anew: no call fails, no tid
// is missing. Prints "running" when it has begun and goes on until the file `stop` is in its
// folder.
#include <ssm.hpp>
#include <string>

#include "check.h"

int main(int argc, char** argv) {
  check_begin(argc, argv);
  const std::string stop = std::string(check_folder) + "/stop";
  SSMApi<int> writer("survivor", 0), reader("survivor", 0);
  CHECK_EQUAL(initSSM(), 1);
  CHECK(writer.create(1.0, 0.1) && reader.open());
  int next = 0;
  while (check_failures == 0 && (next < 1000 || access(stop.c_str(), F_OK) != 0)) {
    writer.data = next;
    CHECK(writer.write() && writer.timeId == next);
    CHECK(reader.readNext() && reader.timeId == next && reader.data == next);
    if (++next == 1000) {
      puts("running");
      fflush(stdout);
    }
    if (next > 1000) usleepSSM(100);
  }
  // The new dssmd knows the stream again: created anew, it goes on where it was.
  SSMApi<int> again("survivor", 0);
  CHECK(again.create(1.0, 0.1) && again.write() && again.timeId == next);
  CHECK(reader.readNext() && reader.timeId == next);
  CHECK_EQUAL(getSSM_num(), 1);
  CHECK_EQUAL(endSSM(), 1);
  return check_result();
}
