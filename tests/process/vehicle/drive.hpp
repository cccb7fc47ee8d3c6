// SPDX-License-Identifier: Apache-2.0
//
// Shared by tests of the whole drive: the command lines of the vehicle's programs. They replay the
// beginning of the recording, with rings that hold all of it, so results do not depend on the speed
// of this machine.
#pragma once

#include <dssm/dssm.hpp>
#include <string>
#include <vector>

#include "tests/support/session.hpp"

namespace vehicle::test {

using Command = std::vector<std::string>;

// The file with the recording.
std::string recording();

// `name` with `arguments`.
Command program(const std::string& name, const Command& arguments);

// encoder or lidar: replays until second `to_s` of the recording.
Command source(const std::string& name, double to_s, const Command& more = {"--speed", "0"});

// Both read existing samples, wait for missing ones, and fail if a sample was lost.
Command localizer();
Command mapper(const std::string& out);

// A program and the dssmd that it uses.
struct Placed {
  const dssm::test::DaemonProcess* host;
  Command command;
};

// Starts all, then waits for all; each must end with status 0.
void run_all(const std::vector<Placed>& programs);

std::string content(const std::string& path);

using dssm::test::connect;

// The number of samples written to `stream`, which `host` owns.
dssm::Tid written(const dssm::test::DaemonProcess& host, const std::string& stream);

}  // namespace vehicle::test
