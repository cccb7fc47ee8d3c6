// SPDX-License-Identifier: Apache-2.0
//
// CLI11 throws what it finds, help included; parse_command_line() is where that ends.
#include "client/dssmctl/options.hpp"

#include <CLI/CLI.hpp>
#include <limits>

#include "client/dssmctl/text.hpp"

namespace dssm::ctl {
namespace {

constexpr std::uint64_t kMaxWindow = 1'000'000;

// An option whose text is read by `read`: std::string(const std::string&), empty or a complaint.
template <class Read>
CLI::Option* add_parsed(CLI::App* app, const std::string& name, const std::string& placeholder,
                        const std::string& description, Read read) {
  return app
      ->add_option_function<std::string>(
          name, [](const std::string&) {}, description)
      ->check(CLI::Validator(std::function<std::string(std::string&)>(read), ""))
      ->type_name(placeholder);
}

template <class Target>
CLI::Option* add_whole(CLI::App* app, const std::string& name, const std::string& placeholder,
                       const std::string& description, Target& target, std::uint64_t least,
                       std::uint64_t most = std::numeric_limits<std::uint64_t>::max()) {
  return add_parsed(app, name, placeholder, description,
                    [&target, least, most](const std::string& text) -> std::string {
                      const Result<std::uint64_t> value = parse_whole(text, least, most);
                      if (!value) return value.error().message;
                      if constexpr (std::is_integral_v<Target>) {
                        target = static_cast<Target>(*value);
                      } else {
                        target = *value;
                      }
                      return {};
                    });
}

enum class Range : unsigned char { any, not_negative, positive };

template <class Target>
CLI::Option* add_seconds(CLI::App* app, const std::string& name, const std::string& description,
                         Target& target, Range range) {
  return add_parsed(app, name, "SECONDS", description,
                    [&target, range](const std::string& text) -> std::string {
                      const Result<Duration> value = parse_seconds(text);
                      if (!value) return value.error().message;
                      if (range == Range::positive && *value <= Duration::zero()) {
                        return "'" + text + "' must be greater than zero";
                      }
                      if (range == Range::not_negative && *value < Duration::zero()) {
                        return "'" + text + "' must not be negative";
                      }
                      target = *value;
                      return {};
                    });
}

CLI::Option* add_real(CLI::App* app, const std::string& name, const std::string& placeholder,
                      const std::string& description, std::optional<double>& target) {
  return add_parsed(app, name, placeholder, description,
                    [&target](const std::string& text) -> std::string {
                      const Result<double> value = parse_real(text);
                      if (!value) return value.error().message;
                      target = *value;
                      return {};
                    });
}

constexpr const char* kStreamHelp = "the stream, as NAME, NAME:ID or NAME:ID@HOST";

void add_stream(CLI::App* app, Options& options) {
  app->add_option("STREAM", options.stream, kStreamHelp)->required()->type_name("");
}

void add_wait(CLI::App* app, Options& options) {
  add_seconds(app, "--wait", "wait so long for the stream to appear, or its host to answer",
              options.wait, Range::not_negative);
}

void add_ls(CLI::App& app, Options& options) {
  CLI::App* ls = app.add_subcommand("ls", "list the streams of all hosts");
  ls->add_option("PATTERN", options.pattern,
                 "only streams whose NAME or NAME:ID this shell pattern fits, as 'camera*'")
      ->type_name("");
  CLI::Option* own = ls->add_flag("--own,--local", options.own, "only those of this host");
  ls->add_option("--host", options.hosts, "only those of this host; may be given several times")
      ->type_name("HOST")
      ->allow_extra_args(false)  // one value per --host, so that PATTERN may follow
      ->excludes(own);
  ls->add_flag("--watch", options.watch, "go on: a line for each stream that comes or goes");
  ls->add_flag("--names", options.names, "only names, one per line, for programs");
  ls->add_option("--sort", options.sort,
                 "created, name, id, host, size, depth, cycle, rate, age, writers, readers, type "
                 "or memory (default: created)")
      ->type_name("KEY")
      ->check(CLI::Validator(
          [](std::string& key) -> std::string {
            for (const char* known : {"created", "name", "id", "host", "size", "depth", "cycle",
                                      "rate", "age", "writers", "readers", "type", "memory"}) {
              if (key == known) return {};
            }
            return "'" + escaped(key) + "' is no key to sort by";
          },
          ""));
  ls->add_flag("-r,--reverse", options.reverse, "the other way round");
}

void add_hosts(CLI::App& app, Options& options) {
  CLI::App* hosts = app.add_subcommand("hosts", "list the hosts, and how they are reached");
  hosts->add_flag("--names", options.names, "only names, one per line, for programs");
  CLI::App* clock = app.add_subcommand("clock", "how good the hosts' clocks are");
  CLI::Option* watch = clock->add_flag("--watch", options.watch, "go on: anew each second");
  CLI::Option* table = add_whole(clock, "--table", "N",
                                 "average, maximum, minimum and standard deviation of N readings, "
                                 "one a second",
                                 options.table, 1, kMaxWindow);
  add_seconds(clock, "--wait", "until this host's clock is good, for so long at most",
              options.clock_wait, Range::not_negative)
      ->excludes(watch)
      ->excludes(table);
  table->excludes(watch);
  app.add_subcommand("doctor", "look for what is wrong, and say what mends it");
  CLI::App* ping = app.add_subcommand("ping", "ask another host's dssmd for a sign of life");
  ping->add_option("HOST", options.host, "a name that `dssmctl hosts` shows")
      ->required()
      ->type_name("");
  add_whole(ping, "-c,--count", "N", "end after N questions", options.count, 1);
  add_seconds(ping, "-i,--interval", "time between two questions (default: 1)", options.interval,
              Range::positive);
}

void add_echo(CLI::App& app, Options& options) {
  CLI::App* echo = app.add_subcommand("echo", "show samples as they come");
  add_stream(echo, options);
  CLI::Option* last = echo->add_flag("--last", options.last, "the newest sample, then end");
  add_parsed(echo, "--at", "TIME",
             "the newest sample at or before TIME, then end: seconds since 1970, or, with a minus "
             "sign, seconds before the newest sample",
             [&options](const std::string& text) -> std::string {
               const Result<Duration> time = parse_seconds(text);
               if (!time) return time.error().message;
               options.at = *time;
               options.at_counts_back = text.starts_with('-');  // also "-0"
               return {};
             })
      ->excludes(last);
  add_whole(echo, "-n,--count", "N", "end after N samples (default: 1 with --at or --last)",
            options.count, 1);
  echo->add_option("--field", options.fields,
                   "only this field, and what is inside it; may be given several times")
      ->type_name("FIELD")
      ->allow_extra_args(false);  // one value per --field, so that STREAM may follow
  echo->add_flag("--full", options.full, "leave nothing out of long payloads");
  echo->add_flag("--csv", options.csv, "a header line, then one row per sample");
  add_wait(echo, options);
}

void add_meter(CLI::App& app, const std::string& name, const std::string& description,
               Options& options) {
  CLI::App* meter = app.add_subcommand(name, description);
  add_stream(meter, options);
  add_whole(meter, "-w,--window", "N", "over the newest N samples (default: 10000)", options.window,
            2, kMaxWindow);
  add_whole(meter, "-n,--count", "N", "end after N reports", options.count, 1);
  add_seconds(meter, "-i,--interval", "time between two reports (default: 1)", options.interval,
              Range::positive);
  add_wait(meter, options);
}

void add_create(CLI::App& app, Options& options) {
  CLI::App* create = app.add_subcommand("create", "create a stream");
  create->add_option("NAME", options.stream, "its name, as NAME, NAME:ID or NAME:ID@HOST")
      ->required()
      ->type_name("");
  add_whole(create, "--size", "BYTES", "bytes per sample", options.payload_bytes, 1,
            kMaxPayloadBytes)
      ->required();
  CLI::Option* depth =
      add_whole(create, "--depth", "N", "slots in the ring", options.depth, kMinDepth, kMaxDepth);
  CLI::Option* life = add_seconds(create, "--life", "history to keep, instead of --depth",
                                  options.life, Range::positive);
  life->excludes(depth);
  CLI::Option* cycle = add_seconds(create, "--cycle", "expected time between two samples",
                                   options.cycle, Range::positive);
  life->needs(cycle);
  create->add_option("--type", options.type, "name of the samples' type")->type_name("NAME");
  add_parsed(create, "--align", "BYTES", "alignment of a sample (default: what fits its size)",
             [&options](const std::string& text) -> std::string {
               const Result<std::uint64_t> value = parse_whole(text, 1, 64);
               if (!value) return value.error().message;
               if ((*value & (*value - 1)) != 0) return "'" + text + "' is no power of two";
               options.alignment_bytes = static_cast<std::uint32_t>(*value);
               return {};
             });
}

void add_property(CLI::App& app, Options& options) {
  CLI::App* property = app.add_subcommand("property", "show or set a stream's property");
  property->require_subcommand(1);
  CLI::App* get = property->add_subcommand("get", "write the property's bytes to a file");
  add_stream(get, options);
  get->add_option("FILE", options.file, "where to; - or nothing: standard output")->type_name("");
  CLI::App* set = property->add_subcommand("set", "replace the property by a file's bytes");
  add_stream(set, options);
  set->add_option("FILE", options.file, "where from; - or nothing: standard input")->type_name("");
}

void add_playback(CLI::App& app, Options& options) {
  CLI::App* playback = app.add_subcommand("playback", "show or turn the PC's playback clock");
  playback->require_subcommand(0, 1);
  playback->add_subcommand("show", "show the clock");
  CLI::App* set = playback->add_subcommand("set", "turn the clock");
  CLI::Option* offset = add_real(set, "--offset", "SECONDS", "its offset from speed * real time",
                                 options.playback_offset_s);
  add_real(set, "--speed", "X", "how fast it runs: 1 as real time, 0 stands, -1 backwards",
           options.playback_speed);
  add_real(set, "--time", "SECONDS", "what time it is on it now, in seconds since 1970",
           options.playback_time_s)
      ->excludes(offset);
  set->require_option(1, 0);
  playback->add_subcommand("pause", "stop the clock");
  playback->add_subcommand("resume", "let it run again");
  playback->add_subcommand("reset", "back to real time");
}

void add_all(CLI::App& app, Options& options) {
  // Global options may also stand behind the verb; verbs made after these lines inherit both.
  app.fallthrough();
  app.footer("--socket and --json may stand before or behind the verb; more in dssmctl(1).");
  app.require_subcommand(1);
  app.set_version_flag("--version", "dssmctl " DSSM_VERSION, "show the version and end");
  app.add_option("--socket", options.socket_path,
                 "where dssmd listens (default: $DSSM_SOCKET, else /run/dssm/dssmd.sock)")
      ->type_name("PATH");
  app.add_flag("--json", options.json, "output for programs");
  add_ls(app, options);
  add_hosts(app, options);
  CLI::App* info = app.add_subcommand("info", "all about one stream, or about dssmd");
  info->add_option("STREAM", options.stream, kStreamHelp)->type_name("");
  add_echo(app, options);
  add_meter(app, "hz", "how often samples come", options);
  add_meter(app, "bw", "how many bytes come", options);
  add_meter(app, "delay", "how old samples are when they arrive", options);
  add_create(app, options);
  CLI::App* rm = app.add_subcommand("rm", "remove streams");
  rm->add_option("STREAM", options.streams, kStreamHelp)->required()->type_name("");
  add_property(app, options);
  add_playback(app, options);
}

// What only several options together can get wrong.
std::string complaint_about(const Options& options) {
  if (options.verb == Verb::create && options.depth == 0 && !options.life) {
    return "how much history? give --depth N, or --life SECONDS and --cycle SECONDS";
  }
  if (options.csv && options.json) return "--csv and --json: choose one";
  if (options.names && options.json) return "--names and --json: choose one";
  if (options.names && options.watch) return "--names and --watch: choose one";
  if (options.watch && (options.reverse || options.sort != Options().sort)) {
    return "--watch shows changes in the order in which they come: leave --sort and --reverse away";
  }
  return {};
}

// The innermost verb that was recognised; `app` itself when there was none.
const CLI::App& innermost(const CLI::App& app) {
  const CLI::App* verb = &app;
  while (!verb->get_subcommands().empty()) verb = verb->get_subcommands().front();
  return *verb;
}

// "property get"; empty without a verb.
std::string verb_name(const CLI::App& app) {
  std::string name;
  for (const CLI::App* verb = &innermost(app); verb->get_parent(); verb = verb->get_parent()) {
    name.insert(0, name.empty() ? verb->get_name() : verb->get_name() + " ");
  }
  return name;
}

std::optional<Verb> verb_of(std::string_view name) {
  static constexpr std::pair<std::string_view, Verb> kVerbs[] = {
      {"ls", Verb::ls},
      {"hosts", Verb::hosts},
      {"clock", Verb::clock},
      {"doctor", Verb::doctor},
      {"ping", Verb::ping},
      {"info", Verb::info},
      {"echo", Verb::echo},
      {"hz", Verb::hz},
      {"bw", Verb::bw},
      {"delay", Verb::delay},
      {"create", Verb::create},
      {"rm", Verb::rm},
      {"property get", Verb::property_get},
      {"property set", Verb::property_set},
      {"playback", Verb::playback_show},
      {"playback show", Verb::playback_show},
      {"playback set", Verb::playback_set},
      {"playback pause", Verb::playback_pause},
      {"playback resume", Verb::playback_resume},
      {"playback reset", Verb::playback_reset},
  };
  for (const auto& [known, verb] : kVerbs) {
    if (known == name) return verb;
  }
  return std::nullopt;
}

CommandLine usage_error(const CLI::App& app, const std::string& complaint) {
  const std::string verb = verb_name(app);
  return {std::nullopt,
          "dssmctl: " + (verb.empty() ? "" : verb + ": ") + escaped_message(complaint) +
              "; see 'dssmctl " + (verb.empty() ? "" : verb + " ") + "--help'\n",
          false};
}

}  // namespace

CommandLine parse_command_line(int argc, const char* const* argv) {
  Options options;
  CLI::App app("Show and manage streams of sensor samples, on this PC and on others.", "dssmctl");
  add_all(app, options);
  if (argc < 2) return {std::nullopt, app.help(), false};
  try {
    app.parse(argc, argv);
  } catch (const CLI::CallForHelp&) {
    return {std::nullopt, app.help(), true};
  } catch (const CLI::CallForVersion& version) {
    return {std::nullopt, version.what() + std::string("\n"), true};
  } catch (const CLI::ParseError& error) {
    const std::vector<std::string> rest = app.remaining(true);
    if (rest.empty()) return usage_error(app, error.what());
    const std::string word = "'" + rest.front() + "'";
    if (rest.front().starts_with('-')) return usage_error(app, "there is no option " + word);
    if (innermost(app).get_subcommands({}).empty()) {
      return usage_error(app, word + " is one word too many");
    }
    return usage_error(app, "there is no verb " + word);
  }
  options.verb_name = verb_name(app);
  const std::optional<Verb> verb = verb_of(options.verb_name);
  if (!verb) return usage_error(app, "a verb is missing");  // not reached: CLI11 insists on one
  options.verb = *verb;
  if (std::string complaint = complaint_about(options); !complaint.empty()) {
    return usage_error(app, complaint);
  }
  return {std::move(options), {}, true};
}

}  // namespace dssm::ctl
