// SPDX-License-Identifier: Apache-2.0
//
// The duration of `dssmctl ls` with 1,000 streams, with process start, compared with starting a
// program that does nothing.
#include <sys/resource.h>

#include <dssm/dssm.hpp>

#include "tests/bench/harness.hpp"
#include "tests/support/daemon_process.hpp"

using namespace dssm;
using namespace dssm::bench;
using namespace std::chrono_literals;

int main() {
  rlimit files{};
  ::getrlimit(RLIMIT_NOFILE, &files);
  files.rlim_cur = files.rlim_max;
  ::setrlimit(RLIMIT_NOFILE, &files);
  test::DaemonProcess daemon;
  Session session = Session::connect({.socket_path = daemon.socket_path()}).value();
  std::vector<Writer<double>> writers;
  for (int i = 0; i < 1000; ++i) {
    writers.push_back(
        session.create<double>("stream" + std::to_string(i), History{100, 10ms}).value());
    for (int n = 0; n < 100; ++n) writers.back().write(1.0, time_from_ns(n * 10'000'000));
  }
  const std::string dssmctl = test::built("client/dssmctl/dssmctl");
  print_head();
  print_pair("start /bin/true", "dssmctl ls, 1,000 streams",
             measure(
                 200, 1, [] { test::run({"/bin/true"}); },
                 [&] {
                   if (test::run({dssmctl, "ls"}, {daemon.environment()}).exit_status != 0)
                     std::abort();
                 }),
             "<= 10 ms");
}
