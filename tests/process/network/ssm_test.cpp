// SPDX-License-Identifier: Apache-2.0
//
// The SSM programs in programs/, which do not name PCs: the writer runs on one PC, the reader on
// another.
#include <fcntl.h>
#include <unistd.h>

#include <fstream>

#include "tests/process/network/fleet.hpp"

namespace dssm::test {
namespace {

class SsmPrograms : public NetworkTest {};

TEST_F(SsmPrograms, ReadAStreamOfAnotherPcUnchanged) {
  if (!make_fleet(2)) return;
  const std::string folder = make_temp_dir();
  int out[2];
  ASSERT_EQ(::pipe2(out, O_CLOEXEC), 0);
  const pid_t writer = start({built("tests/process/network/odometry-writer"), folder},
                             {fleet->dssmd(1).environment()}, out[1]);
  ::close(out[1]);
  char running = 0;
  ASSERT_EQ(::read(out[0], &running, 1), 1);
  const Finished reader = run({built("tests/process/network/odometry-reader"), folder},
                              {fleet->dssmd(2).environment()});
  EXPECT_EQ(reader.exit_status, 0) << reader.out << reader.err;
  std::ofstream(folder + "/stop").close();
  EXPECT_EQ(wait_for(writer), 0);
  ::close(out[0]);
  remove_tree(folder);
}

}  // namespace
}  // namespace dssm::test
