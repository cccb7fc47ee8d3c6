// SPDX-License-Identifier: Apache-2.0
//
// A program that writes the load of a host until it is killed: load_writer HOST PERCENT LIFE.
// Prints one byte when it starts to write.
#include <unistd.h>

#include <cstdlib>
#include <dssm/dssm.hpp>

#include "tests/process/network/load.hpp"

int main(int, char** argv) {
  using namespace dssm;
  const std::atomic<bool> stop = false;
  const std::vector<test::KnownStream> streams =
      test::load_of(std::atoi(argv[1]), std::strtoull(argv[2], nullptr, 10));
  Session session = Session::connect({.request_timeout = std::chrono::minutes(2)}).value();
  if (::write(STDOUT_FILENO, "x", 1) != 1) return 1;
  test::LoadWriter(std::move(session), streams, std::strtoull(argv[3], nullptr, 10))
      .write_until(stop);
}
