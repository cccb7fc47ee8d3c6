// SPDX-License-Identifier: Apache-2.0
//
// A program to be killed: creates, writes, opens and closes streams for ever, and says on stdout
// when it has done so the given number of times.
#include <unistd.h>

#include <array>
#include <cstdlib>
#include <dssm/dssm.hpp>

int main(int, char** argv) {
  using namespace std::chrono_literals;
  using Sample = std::array<std::int64_t, 16>;
  const int enough = std::atoi(argv[1]);
  dssm::Session session = dssm::Session::connect({.request_timeout = 60s}).value();
  for (int i = 0;; ++i) {
    const std::string name = "victim:" + std::to_string(i % 3);
    auto writer = session.create<Sample>(name, dssm::History{16, 1ms}).value();
    writer.write(Sample{i});
    auto reader = session.open_reader<Sample>(name).value();
    if (i == enough && ::write(STDOUT_FILENO, "x", 1) != 1) return 1;
  }
}
