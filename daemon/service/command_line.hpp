// SPDX-License-Identifier: Apache-2.0
//
// dssmd's command line. Every configuration key is a flag; a flag wins over the file.
#pragma once

#include <dssm/result.hpp>
#include <string>

#include "daemon/service/config.hpp"

namespace dssm::daemon {

struct CommandLine {
  // What was asked for. `print`: show `text` and leave with success (--help, --version).
  enum class Action : std::uint8_t { run, check_config, print } action = Action::run;
  std::string text;
  std::string config_path;  // empty: none given
  Config config;            // from file and flags, complete; set unless `print`
};

// Fails with invalid_argument, one line per mistake.
Result<CommandLine> parse_command_line(int argc, const char* const* argv);

}  // namespace dssm::daemon
