// SPDX-License-Identifier: Apache-2.0
#include "tests/process/vehicle/drive.hpp"

#include <gtest/gtest.h>

#include <cstdlib>
#include <fstream>
#include <iterator>

namespace vehicle::test {

std::string recording() {
  return std::string(std::getenv("DSSM_SOURCE_ROOT")) +
         "/docs/examples/vehicle/data/freiburg-079.carmen.log.gz";
}

Command program(const std::string& name, const Command& arguments) {
  Command command{dssm::test::built("docs/examples/vehicle/" + name)};
  command.insert(command.end(), arguments.begin(), arguments.end());
  return command;
}

Command source(const std::string& name, double to_s, const Command& more) {
  Command arguments{"--log",  recording(), "--to",     std::to_string(to_s),
                    "--life", "1000",      "--stamps", "recording"};
  arguments.insert(arguments.end(), more.begin(), more.end());
  return program(name, arguments);
}

Command localizer() { return program("localizer", {"--late", "--complete", "--deadline", "600"}); }

Command mapper(const std::string& out) {
  return program("mapper",
                 {"--late", "--complete", "--deadline", "600", "--timeout", "600", "--out", out});
}

void run_all(const std::vector<Placed>& programs) {
  std::vector<pid_t> pids;
  for (const Placed& one : programs) {
    pids.push_back(dssm::test::start(one.command, {one.host->environment()}));
  }
  for (std::size_t i = 0; i < pids.size(); ++i) {
    EXPECT_EQ(dssm::test::wait_for(pids[i]), 0) << programs[i].command[0];
  }
}

std::string content(const std::string& path) {
  std::ifstream file(path, std::ios::binary);
  return {std::istreambuf_iterator<char>(file), {}};
}

dssm::Tid written(const dssm::test::DaemonProcess& host, const std::string& stream) {
  dssm::Session session = connect(host);
  return session.stream_info(dssm::StreamId{stream, 0, ""}).value().newest + 1;
}

}  // namespace vehicle::test
