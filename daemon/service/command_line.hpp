// SPDX-License-Identifier: Apache-2.0
//
// dssmd's configuration: at its start from the command line and the file that it names, and read
// again after SIGHUP. Every configuration key is a flag; a flag wins over the file.
#pragma once

#include <dssm/result.hpp>
#include <functional>
#include <string>

#include "daemon/base/log.hpp"
#include "daemon/service/config.hpp"

namespace dssm::daemon {

struct CommandLine {
  // What was asked for. `print`: show `text` and leave with success (--help, --version).
  enum class Action : std::uint8_t { run, check_config, print } action = Action::run;
  std::string text;
  Config config;  // from file and flags, complete; set unless `print`
};

// Fails with invalid_argument, one line per mistake.
Result<CommandLine> parse_command_line(int argc, const char* const* argv);

// SIGHUP: reads the configuration again. If it has a mistake, all mistakes are logged and nothing
// changes. Otherwise the keys that may change while dssmd runs take effect at once, and those that
// need a restart are logged.
class Reloader {
 public:
  using Read = std::function<Result<Config>()>;
  using Apply = std::function<void(const Config&)>;

  // config: what dssmd runs with. apply: takes over the keys that may change at once. logger:
  // outlives it.
  Reloader(const Config& config, Read read, Apply apply, Logger& logger)
      : started_with_(config),
        applied_(config),
        read_(std::move(read)),
        apply_(std::move(apply)),
        logger_(logger) {}

  void reload();

 private:
  const Config started_with_;
  Config applied_;
  Read read_;
  Apply apply_;
  Logger& logger_;
};

}  // namespace dssm::daemon
