// SPDX-License-Identifier: Apache-2.0
#include "daemon/service/command_line.hpp"

#include <CLI/CLI.hpp>
#include <algorithm>
#include <map>

namespace dssm::daemon {
namespace {

std::string flag_of(std::string_view key) {
  std::string flag = "--" + std::string(key);
  std::replace(flag.begin(), flag.end(), '_', '-');
  return flag;
}

// File first, flags over it; all mistakes of both, one per line.
Result<void> collect(CommandLine& line, const std::map<std::string_view, std::string>& flags) {
  std::string mistakes;
  const auto note = [&](const std::string& mistake) {
    mistakes.append(mistakes.empty() ? "" : "\n").append(mistake);
  };
  if (!line.config_path.empty()) {
    if (Result<void> applied = apply_file(line.config, line.config_path); !applied) {
      note(applied.error().message);
    }
  }
  for (const ConfigKey& key : config_keys()) {
    const auto flag = flags.find(key.name);
    if (flag == flags.end()) continue;
    if (Result<void> set = key.set(line.config, flag->second); !set) {
      note(flag_of(key.name) + ": " + set.error().message);
    }
  }
  if (mistakes.empty()) {
    if (Result<void> finished = finish(line.config); !finished) note(finished.error().message);
  }
  if (mistakes.empty()) return {};
  return Error{Errc::invalid_argument, mistakes};
}

}  // namespace

Result<CommandLine> parse_command_line(int argc, const char* const* argv) {
  CommandLine line;
  std::map<std::string_view, std::string> flags;
  bool check = false;
  // CLI11 reports by exceptions; they end here.
  try {
    CLI::App app("Owns the streams of this PC: rings in shared memory, found by name.", "dssmd");
    app.footer(
        "Each flag but --help, --version, --config and --check-config is also a key of the\n"
        "configuration file, with '_' for '-'. See dssmd(8) and docs/configuration.md.");
    app.set_version_flag("--version", "dssmd " DSSM_VERSION);
    app.add_option("--config", line.config_path, "configuration file (TOML)")->type_name("FILE");
    app.add_flag("--check-config", check, "only check the configuration: print OK or the mistakes");
    for (const ConfigKey& key : config_keys()) {
      app.add_option_function<std::string>(
             flag_of(key.name), [&flags, &key](const std::string& text) { flags[key.name] = text; },
             std::string(key.help))
          ->type_name(std::string(key.value));
    }
    try {
      app.parse(argc, argv);
    } catch (const CLI::CallForHelp&) {
      line.action = CommandLine::Action::print;
      line.text = app.help();
      return line;
    } catch (const CLI::CallForVersion& version) {
      line.action = CommandLine::Action::print;
      line.text = std::string(version.what()) + "\n";
      return line;
    }
  } catch (const CLI::Error& error) {
    return Error{Errc::invalid_argument,
                 std::string(error.what()) + "; `dssmd --help` lists the flags"};
  }
  line.action = check ? CommandLine::Action::check_config : CommandLine::Action::run;
  if (Result<void> collected = collect(line, flags); !collected) {
    return std::move(collected).error();
  }
  return line;
}

}  // namespace dssm::daemon
