// SPDX-License-Identifier: Apache-2.0
//
// A program to be killed: creates, writes, opens and closes streams for ever, and says on stdout
// when it has done so the given number of times. `victim throw` ends by an exception that a
// callback throws.
#include <unistd.h>

#include <array>
#include <cstdlib>
#include <dssm/dssm.hpp>
#include <stdexcept>
#include <string_view>

int main(int, char** argv) {
  using namespace std::chrono_literals;
  using Sample = std::array<std::int64_t, 16>;
  dssm::Session session = dssm::Session::connect({.request_timeout = 60s}).value();
  if (argv[1] == std::string_view("throw")) {
    auto writer = session.create<Sample>("victim", dssm::History{16, 1ms}).value();
    writer.write(Sample{});
    const auto handle = session.subscribe<Sample>(
        "victim", [](const dssm::Sample<Sample>&) { throw std::runtime_error("from a callback"); });
    for (;;) ::pause();
  }
  const int enough = std::atoi(argv[1]);
  for (int i = 0;; ++i) {
    const std::string name = "victim:" + std::to_string(i % 3);
    auto writer = session.create<Sample>(name, dssm::History{16, 1ms}).value();
    writer.write(Sample{i});
    auto reader = session.open_reader<Sample>(name).value();
    if (i == enough && ::write(STDOUT_FILENO, "x", 1) != 1) return 1;
  }
}
