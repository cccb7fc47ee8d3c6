// SPDX-License-Identifier: Apache-2.0
//
// Broadcasts: what each PC shows to the others. Arguments: FOLDER MINE THEIRS: shows the block with
// number MINE, and waits until some other host shows THEIRS.
#include <string>

#include "check.h"
#include "dssm.hpp"

namespace {

struct Block {
  int number;
  char text[1000];  // more than the old packets took
};
struct Other {
  int number;
};

}  // namespace

int main(int argc, char** argv) {
  check_begin(argc, argv);
  const int mine = atoi(argv[2]), theirs = atoi(argv[3]);
  DSSMApiWithProp<int, Block> con("", 0);
  con.br_data.number = mine;
  snprintf(con.br_data.text, sizeof(con.br_data.text), "block %d", mine);
  CHECK(con.sendBroadcast());
  bool saw_mine = false, saw_theirs = false;
  while (!saw_mine || !saw_theirs) {
    std::vector<DSSMApiWithProp<int, Block>::BrInfo> hosts = con.receiveBroadcast();
    for (unsigned i = 0; i < hosts.size(); ++i) {
      if (!hosts[i].data_flg) continue;
      CHECK(hosts[i].data.number == mine || hosts[i].data.number == theirs);
      CHECK(std::string(hosts[i].data.text) == "block " + std::to_string(hosts[i].data.number));
      CHECK(!hosts[i].ipaddr.empty() && atoi(hosts[i].port.c_str()) > 0);
      saw_mine = saw_mine || hosts[i].data.number == mine;
      saw_theirs = saw_theirs || hosts[i].data.number == theirs;
    }
    usleep(10000);
  }
  // Another program's type does not fit: said, not written over memory.
  DSSMApiWithProp<int, Other> small("", 0);
  std::vector<DSSMApiWithProp<int, Other>::BrInfo> hosts = small.receiveBroadcast();
  CHECK_EQUAL(hosts.size(), 2);
  for (unsigned i = 0; i < hosts.size(); ++i) CHECK(!hosts[i].data_flg);
  return check_result();
}
