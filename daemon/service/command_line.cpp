// SPDX-License-Identifier: Apache-2.0
#include "daemon/service/command_line.hpp"

#include <CLI/CLI.hpp>
#include <algorithm>
#include <map>
#include <string>
#include <string_view>
#include <vector>

#include "core/base/try.hpp"
#include "daemon/base/message_ids.hpp"

namespace dssm::daemon {
namespace {

// By key: what its flag was given, in order.
using Flags = std::map<std::string_view, std::vector<std::string>>;

// File first, flags over it; all mistakes of both, one per line.
Result<void> collect(CommandLine& line, const Flags& flags) {
  std::string mistakes;
  const auto note = [&](const std::string& mistake) {
    mistakes.append(mistakes.empty() ? "" : "\n").append(mistake);
  };
  if (!line.config.file.empty()) {
    if (Result<void> applied = apply_file(line.config, line.config.file); !applied) {
      note(applied.error().message);
    }
  }
  for (const ConfigKey& key : config_keys()) {
    const auto flag = flags.find(key.name);
    if (flag == flags.end()) continue;
    if (key.clear) key.clear(line.config);
    for (const std::string& text : flag->second) {
      if (Result<void> set = key.set(line.config, text); !set) {
        note(key.flag() + ": " + set.error().message);
      }
    }
  }
  if (mistakes.empty()) {
    if (Result<void> finished = finish(line.config); !finished) note(finished.error().message);
  }
  if (mistakes.empty()) return {};
  return Error{Errc::invalid_argument, mistakes};
}

void add_flag(CLI::App& app, const ConfigKey& key, Flags& flags) {
  const std::string help(key.help);
  if (key.form == ValueForm::boolean) {
    app.add_flag_function(
        key.flag(),
        [&flags, &key](std::int64_t count) { flags[key.name] = {count > 0 ? "true" : "false"}; },
        help);
    return;
  }
  CLI::Option* option = app.add_option_function<std::vector<std::string>>(
      key.flag(),
      [&flags, &key](const std::vector<std::string>& texts) { flags[key.name] = texts; }, help);
  option->type_name(std::string(key.value));
  // One value after each flag; CLI11 takes all that follow otherwise.
  option->allow_extra_args(false);
  if (key.form != ValueForm::list) option->expected(1);
}

void add(std::string& list, std::string_view name) {
  list.append(list.empty() ? "" : ", ").append(name);
}

}  // namespace

Result<CommandLine> parse_command_line(int argc, const char* const* argv) {
  CommandLine line;
  Flags flags;
  bool check = false;
  // CLI11 reports by exceptions; they end here.
  try {
    CLI::App app("Owns the streams of this PC: rings in shared memory, found by name.", "dssmd");
    app.footer(
        "Each flag but --help, --version, --config and --check-config is also a key of the\n"
        "configuration file, with '_' for '-' (--peer is the key 'peers'). See dssmd(8) and\n"
        "docs/configuration.md.");
    app.set_version_flag("--version", "dssmd " DSSM_VERSION);
    app.add_option("--config", line.config.file, "configuration file (TOML)")->type_name("FILE");
    app.add_flag("--check-config", check, "only check the configuration: print OK or the mistakes");
    for (const ConfigKey& key : config_keys()) add_flag(app, key, flags);
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
  DSSM_TRY(collect(line, flags));
  return line;
}

// --- reloading

void Reloader::reload() {
  const Result<Config> read = read_();
  if (!read) {
    std::string_view mistakes = read.error().message;
    while (!mistakes.empty()) {
      const std::string_view line = mistakes.substr(0, mistakes.find('\n'));
      logger_.error("reload: " + std::string(line) + "; everything stays as it was",
                    {.message_id = message_id::kReloadFailed});
      mistakes.remove_prefix(std::min(line.size() + 1, mistakes.size()));
    }
    return;
  }
  std::string changed, needs_restart;
  for (const ConfigKey& key : config_keys()) {
    if (key.change.at_once) {
      if (!key.change.is_same(*read, applied_)) add(changed, key.name);
    } else if (!key.change.is_same(*read, started_with_)) {
      add(needs_restart, key.name);
    }
  }
  applied_ = *read;
  apply_(applied_);
  logger_.notice("configuration read again: " +
                     (changed.empty() ? "nothing changed at once" : "changed " + changed),
                 {.message_id = message_id::kReloaded});
  if (needs_restart.empty()) return;
  logger_.warning(
      "the configuration differs from the one in use in keys that count from the next "
      "start on (systemctl restart dssmd): " +
          needs_restart,
      {.message_id = message_id::kRestartNeeded});
}

}  // namespace dssm::daemon
