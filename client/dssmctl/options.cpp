// SPDX-License-Identifier: Apache-2.0
//
// Each verb is a subcommand of CLI11. Its options are stored in a struct that the subcommand's
// callback holds; the callback of the verb that was typed checks what only several options together
// can get wrong, and hands the struct over. CLI11 throws what it finds, help included;
// parse_command_line() is where that ends.
#include "client/dssmctl/options.hpp"

#include <fmt/format.h>

#include <CLI/CLI.hpp>
#include <algorithm>
#include <array>
#include <bit>
#include <dssm/reader.hpp>
#include <filesystem>
#include <limits>
#include <memory>
#include <span>

#include "client/dssmctl/config_words.hpp"
#include "client/dssmctl/names.hpp"
#include "client/dssmctl/recording_info.hpp"
#include "client/dssmctl/stream_list.hpp"
#include "client/dssmctl/text.hpp"
#include "client/dssmctl/top_display.hpp"
#include "client/dssmctl/trigger_watch.hpp"
#include "core/base/try.hpp"

namespace dssm::ctl {
namespace {

constexpr std::uint64_t kMaxWindow = 1'000'000;
constexpr std::uint64_t kMaxDays = 36'500;  // of a certificate; the CA's own end limits it too

// An option whose text is read by `read`: Result<void>(const std::string&).
template <class Read>
CLI::Option* add_parsed(CLI::App* app, const std::string& name, const std::string& placeholder,
                        const std::string& description, Read read) {
  const auto check = [read](std::string& text) {
    const Result<void> done = read(text);
    return done ? "" : done.error().message;
  };
  return app
      ->add_option_function<std::string>(
          name, [](const std::string&) {}, description)
      ->check(CLI::Validator(std::function<std::string(std::string&)>(check), ""))
      ->type_name(placeholder);
}

template <class Target>
CLI::Option* add_whole(CLI::App* app, const std::string& name, const std::string& placeholder,
                       const std::string& description, Target& target, std::uint64_t min,
                       std::uint64_t max = std::numeric_limits<std::uint64_t>::max()) {
  return add_parsed(app, name, placeholder, description,
                    [&target, min, max](const std::string& text) -> Result<void> {
                      target = DSSM_TRY(parse_whole(text, min, max));
                      return {};
                    });
}

enum class Range : unsigned char { not_negative, positive };

template <class Target>
CLI::Option* add_seconds(CLI::App* app, const std::string& name, const std::string& description,
                         Target& target, Range range) {
  return add_parsed(
      app, name, "DURATION", description,
      [&target, range](const std::string& text) -> Result<void> {
        const Duration value = DSSM_TRY(parse_duration(text));
        if (range == Range::positive && value <= Duration::zero()) {
          return Error{Errc::invalid_argument, fmt::format("'{}' must be greater than zero", text)};
        }
        if (value < Duration::zero()) {
          return Error{Errc::invalid_argument, fmt::format("'{}' must not be negative", text)};
        }
        target = value;
        return {};
      });
}

CLI::Option* add_moment(CLI::App* app, const std::string& name, const std::string& description,
                        std::optional<Moment>& target,
                        Result<Moment> (*parse)(std::string_view, Time) = parse_moment) {
  return add_parsed(app, name, "TIME", description,
                    [&target, parse](const std::string& text) -> Result<void> {
                      target = DSSM_TRY(parse(text, WallClock::now()));
                      return {};
                    });
}

CLI::Option* add_real(CLI::App* app, const std::string& name, const std::string& placeholder,
                      const std::string& description, std::optional<double>& target) {
  return add_parsed(app, name, placeholder, description,
                    [&target](const std::string& text) -> Result<void> {
                      target = DSSM_TRY(parse_real(text));
                      return {};
                    });
}

// Help without what options exclude and need: the error says that.
class HelpFormatter : public CLI::Formatter {
 public:
  std::string make_option_opts(const CLI::Option* option) const override {
    if (option->get_type_size() == 0) return {};
    std::string text = option->get_type_name().empty() ? "" : " " + option->get_type_name();
    if (option->get_expected_max() == CLI::detail::expected_max_vector_size) text += " ...";
    if (option->get_required()) text += " REQUIRED";
    return text;
  }
};

constexpr const char* kStreamHelp = "the stream, as NAME, NAME:ID or NAME:ID@HOST";

// What the callbacks of the verbs fill in.
struct Parsed {
  CommonOptions common;
  std::optional<Options> options;
};

// Not what CLI11 checks itself.
void require(bool condition, const std::string& error) {
  if (!condition) throw CLI::ValidationError(error);
}

// The options of `verb`, which are handed over when it is the innermost verb that was typed.
// `check` may call require(); options are complete then, global ones included.
template <class VerbOptions, class Check>
VerbOptions& add_options(CLI::App* verb, Parsed& parsed, Check check) {
  const auto options = std::make_shared<VerbOptions>();
  verb->callback([verb, options, check, &parsed] {
    if (!verb->get_subcommands().empty()) return;
    static_cast<CommonOptions&>(*options) = parsed.common;
    check(*options);
    parsed.options = *options;
  });
  return *options;
}

template <class VerbOptions>
VerbOptions& add_options(CLI::App* verb, Parsed& parsed) {
  return add_options<VerbOptions>(verb, parsed, [](const VerbOptions&) {});
}

void add_stream(CLI::App* verb, std::string& stream) {
  verb->add_option("STREAM", stream, kStreamHelp)->required()->type_name("");
}

void add_wait(CLI::App* verb, Duration& wait) {
  add_seconds(verb, "--wait", "wait so long for the stream to appear, or its host to answer", wait,
              Range::not_negative);
}

void add_interval(CLI::App* verb, const std::string& of, Duration& interval) {
  add_seconds(verb, "-i,--interval", fmt::format("time between two {} (default: 1)", of), interval,
              Range::positive);
}

void add_watch(CLI::App* verb, bool& watch) {
  verb->add_flag("--watch", watch,
                 "continue: on a terminal redrawn each second, else printed again when it changes");
}

// As --wide, which all verbs have; -w is taken in others.
void add_wide(CLI::App* verb, Parsed& parsed) {
  verb->add_flag("-w", parsed.common.wide, "as --wide");
}

void add_names(CLI::App* verb, bool& names) {
  verb->add_flag("--names", names, "only names, one per line, for programs");
}

void check_ls(const LsOptions& options) {
  require(!options.names || !options.json, "--names and --json: choose one");
  require(!options.names || !options.watch, "--names and --watch: choose one");
  require(!options.watch || (!options.reverse && options.sort == LsOptions().sort),
          "--watch shows changes in the order in which they come: omit --sort and --reverse");
}

// What is wrong with `key`; empty: it is one of `keys`.
std::string check_sort_key(std::string_view key, std::span<const std::string_view> keys) {
  if (std::find(keys.begin(), keys.end(), key) != keys.end()) return {};
  return fmt::format("'{}' is not a key to sort by; there are {}", escaped(key),
                     fmt::join(keys, ", "));
}

void add_ls(CLI::App& app, Parsed& parsed) {
  CLI::App* ls = app.add_subcommand("ls", "list the streams of all hosts");
  LsOptions& options = add_options<LsOptions>(ls, parsed, check_ls);
  ls->add_option("PATTERN", options.pattern,
                 "only streams whose NAME or NAME:ID this shell pattern fits, as 'camera*'")
      ->type_name("");
  CLI::Option* own =
      ls->add_flag("--own,--local", options.own, "only the streams that this PC owns");
  ls->add_option("--host", options.hosts,
                 "only the streams that HOST owns; may be given several times")
      ->type_name("HOST")
      ->allow_extra_args(false)  // one value per --host, so that PATTERN may follow
      ->excludes(own);
  ls->add_flag(
      "--watch", options.watch,
      "a log: a line for each stream that is there, then for each that is added or removed");
  add_names(ls, options.names);
  ls->add_option("--sort", options.sort,
                 "created, name, id, host, size, depth, cycle, rate, age, writers, readers, type "
                 "or memory (default: created)")
      ->type_name("KEY")
      ->check(CLI::Validator(
          std::function([](std::string& key) { return check_sort_key(key, stream_sort_keys()); }),
          ""));
  ls->add_flag("-r,--reverse", options.reverse, "in reverse order");
  add_wide(ls, parsed);
}

void add_hosts(CLI::App& app, Parsed& parsed) {
  CLI::App* hosts = app.add_subcommand("hosts", "list the hosts, and how they are reached");
  HostsOptions& options = add_options<HostsOptions>(hosts, parsed, [](const HostsOptions& all) {
    require(!all.names || !all.json, "--names and --json: choose one");
    require(!all.names || !all.watch, "--names and --watch: choose one");
  });
  add_names(hosts, options.names);
  add_watch(hosts, options.watch);
  add_wide(hosts, parsed);
}

void add_nodes(CLI::App& app, Parsed& parsed) {
  CLI::App* nodes =
      app.add_subcommand("nodes", "list the processes, and what each reads and writes");
  NodesOptions& options = add_options<NodesOptions>(nodes, parsed);
  nodes
      ->add_option("PATTERN", options.pattern,
                   "only processes whose program's name this shell pattern fits, as 'map*'")
      ->type_name("");
  nodes
      ->add_option("--host", options.hosts,
                   "only processes on this host; may be given several times")
      ->type_name("HOST")
      ->allow_extra_args(false);  // one value per --host, so that PATTERN may follow
}

void check_top(const TopOptions& options) {
  if (options.sort.empty()) return;
  const std::string error = check_sort_key(options.sort, sort_keys(options.view));
  require(error.empty(), error + "; --view hosts and --view programs have keys of their own");
}

void add_top(CLI::App& app, Parsed& parsed) {
  CLI::App* top = app.add_subcommand("top", "streams, hosts and programs, redrawn each second");
  TopOptions& options = add_options<TopOptions>(top, parsed, check_top);
  top->add_option("PATTERN", options.pattern,
                  "only rows whose name this shell pattern fits, or that have this part")
      ->type_name("");
  add_parsed(top, "--view", "VIEW", "streams, hosts or programs (default: streams)",
             [&options](const std::string& text) -> Result<void> {
               for (const TopView view : {TopView::streams, TopView::hosts, TopView::programs}) {
                 if (text != view_name(view)) continue;
                 options.view = view;
                 return {};
               }
               return Error{Errc::invalid_argument,
                            fmt::format("'{}' is not a view; there are streams, hosts and programs",
                                        escaped(text))};
             });
  top->add_option("--sort", options.sort,
                  "streams: as `ls` sorts; hosts: found, host, state, rtt, streams or clock; "
                  "programs: host, pid, program, writes or reads")
      ->type_name("KEY");
  top->add_flag("-r,--reverse", options.reverse, "in reverse order");
  add_seconds(top, "-i,--interval,--every", "time between two updates (default: 1)",
              options.interval, Range::positive);
  add_whole(top, "-n,--count", "N", "end after N updates", options.count, 1);
}

void add_graph(CLI::App& app, Parsed& parsed) {
  CLI::App* graph =
      app.add_subcommand("graph", "draw which processes read and write which streams");
  GraphOptions& options = add_options<GraphOptions>(graph, parsed, [](const GraphOptions& all) {
    require(all.out.empty() || !all.json, "--out and --json: choose one");
  });
  add_parsed(graph, "--out", "FILE",
             "the file to write, which ends in .svg or .png (drawn by Graphviz) or .dot (default: "
             "standard output, in Graphviz's language DOT)",
             [&options](const std::string& text) -> Result<void> {
               for (const char* format : {"dot", "svg", "png"}) {
                 if (!text.ends_with(std::string(".") + format)) continue;
                 options.out = text;
                 options.format = format;
                 return {};
               }
               return Error{Errc::invalid_argument,
                            fmt::format("'{}' does not end in .svg, .png or .dot", escaped(text))};
             });
}

void add_clock(CLI::App& app, Parsed& parsed) {
  CLI::App* clock = app.add_subcommand("clock", "how good the hosts' clocks are");
  ClockOptions& options = add_options<ClockOptions>(clock, parsed);
  add_watch(clock, options.watch);
  add_wide(clock, parsed);
  CLI::Option* watch = clock->get_option("--watch");
  CLI::Option* matrix =
      clock->add_flag("--matrix", options.matrix,
                      "a row for each pair of hosts: how far their clocks may be apart");
  CLI::Option* table = add_whole(clock, "--table", "N",
                                 "average, maximum, minimum and standard deviation of N readings, "
                                 "one a second",
                                 options.table, 1, kMaxWindow);
  add_seconds(
      clock, "--wait",
      "until reads by time accept the samples of all hosts that are up, for so long at most",
      options.wait, Range::not_negative)
      ->excludes(watch)
      ->excludes(matrix)
      ->excludes(table);
  table->excludes(watch)->excludes(matrix);
}

void add_ping(CLI::App& app, Parsed& parsed) {
  CLI::App* ping = app.add_subcommand("ping", "test whether another host's dssmd answers");
  PingOptions& options = add_options<PingOptions>(ping, parsed);
  ping->add_option("HOST", options.host, "a name that `dssmctl hosts` shows")
      ->required()
      ->type_name("");
  add_whole(ping, "-n,-c,--count", "N", "end after N questions", options.count, 1);
  add_interval(ping, "questions", options.interval);
}

void add_info(CLI::App& app, Parsed& parsed) {
  CLI::App* info = app.add_subcommand("info", "all about one stream or recording, or about dssmd");
  InfoOptions& options = add_options<InfoOptions>(info, parsed, [](const InfoOptions& all) {
    require(!all.watch || !is_recording(all.stream), "--watch: of a stream, not of a recording");
  });
  info->add_option(
          "STREAM", options.stream,
          std::string(kStreamHelp) +
              "; or a recording: a file *.mcap or *.log, a path, or a name that no stream has")
      ->type_name("");
  add_watch(info, options.watch);
}

void add_echo(CLI::App& app, Parsed& parsed) {
  CLI::App* echo = app.add_subcommand("echo", "show samples as they come");
  EchoOptions& options = add_options<EchoOptions>(echo, parsed, [](const EchoOptions& all) {
    require(!all.csv || !all.json, "--csv and --json: choose one");
  });
  add_stream(echo, options.stream);
  CLI::Option* last = echo->add_flag("--last", options.last, "the newest sample, then end");
  add_moment(
      echo, "--at",
      "the newest sample at or before TIME, then end: seconds since 1970, ISO 8601, now, or, "
      "with a minus sign, so long before the newest sample (-1.5, -500ms)",
      options.at)
      ->excludes(last);
  add_whole(echo, "-n,--count", "N", "end after N samples (default: 1 with --at or --last)",
            options.count, 1);
  echo->add_option("--field", options.fields,
                   "only this field, and what is inside it; may be given several times")
      ->type_name("FIELD")
      ->allow_extra_args(false);  // one value per --field, so that STREAM may follow
  echo->add_flag("--full", options.full, "leave nothing out of long payloads");
  echo->add_flag("--csv", options.csv, "a header line, then one row per sample");
  add_wait(echo, options.wait);
}

void add_plot(CLI::App& app, Parsed& parsed) {
  CLI::App* plot = app.add_subcommand("plot", "draw fields of streams over time");
  PlotOptions& options = add_options<PlotOptions>(plot, parsed, [](const PlotOptions& all) {
    require(all.out.empty() || !all.json, "--out and --json: choose one");
  });
  plot->add_option("STREAM.FIELD", options.targets,
                   "one curve for each: odometry.pose.x, lidar.ranges[3]")
      ->required()
      ->type_name("...");
  add_seconds(plot, "--span", "how much time is drawn (default: 10s)", options.span,
              Range::positive);
  add_seconds(plot, "--for", "end after so long; with --out: then draw it (default: at once)",
              options.duration, Range::positive);
  add_parsed(plot, "--out", "FILE", "the file to write, which ends in .svg or .png (by gnuplot)",
             [&options](const std::string& text) -> Result<void> {
               if (text.ends_with(".svg") || text.ends_with(".png")) {
                 options.out = text;
                 return {};
               }
               return Error{Errc::invalid_argument,
                            fmt::format("'{}' does not end in .svg or .png", escaped(text))};
             });
  add_wait(plot, options.wait);
}

void check_pub(PubOptions& options) {
  require(options.from_stdin || !options.times,
          "--times: only with --stdin, whose lines have them");
  require(!options.from_stdin || options.assignments.empty(),
          "--stdin: the fields come from standard input; omit FIELD=VALUE");
  // Zeros may be a command, too, but not one that is given by mistake.
  require(
      options.from_stdin || !options.assignments.empty(),
      "give at least one FIELD=VALUE, as x=0, or --stdin; `dssmctl info STREAM` lists the fields");
  for (const std::string& assignment : options.assignments) {
    require(assignment.find('=', 1) != std::string::npos,
            fmt::format("'{}' is not FIELD=VALUE, as x=1.5", escaped(assignment)));
  }
  if (options.from_stdin || options.period) return;
  require(!options.count, "--count: only with --rate or --stdin");
  options.count = 1;
}

void add_pub(CLI::App& app, Parsed& parsed) {
  CLI::App* pub = app.add_subcommand("pub", "write samples to a stream");
  PubOptions& options = add_options<PubOptions>(pub, parsed, check_pub);
  add_stream(pub, options.stream);
  pub->add_option(
         "FIELD=VALUE", options.assignments,
         "what the sample holds, as x=1.5, pose.x=2, name=front or 'ranges=[1,2]'; 0 where "
         "nothing is given")
      ->type_name("");
  add_parsed(pub, "-r,--rate", "HZ", "so many samples a second, until Ctrl-C or --count",
             [&options](const std::string& text) -> Result<void> {
               constexpr double kMaxRate = 1e6;
               const double rate = DSSM_TRY(parse_real(text));
               if (!(rate > 0 && rate <= kMaxRate)) {
                 return Error{Errc::invalid_argument,
                              fmt::format("'{}' is not a rate above 0 and up to 1000000", text)};
               }
               options.period =
                   std::chrono::duration_cast<Duration>(std::chrono::duration<double>(1 / rate));
               return {};
             });
  add_whole(pub, "-n,--count", "N", "end after N samples", options.count, 1);
  pub->add_flag("--stdin", options.from_stdin,
                "samples from standard input, as `echo` prints them with --json or --csv");
  pub->add_flag("--times", options.times, "with the times in the input, not the present one");
}

std::string check_compression(std::string& name) {
  if (name == "lz4" || name == "zstd" || name == "none") return {};
  return fmt::format("'{}' is not a compression; there are lz4, zstd and none", escaped(name));
}

void add_record_limits(CLI::App* record, RecordOptions& options) {
  const auto add_bytes = [&](const char* name, const char* description, std::uint64_t& target) {
    add_parsed(record, name, "SIZE", description,
               [&target](const std::string& text) -> Result<void> {
                 target = DSSM_TRY(parse_bytes(text, 1));
                 return {};
               });
  };
  add_bytes("--max-file-size", "begin another file at this size, as 500MiB or 2GiB",
            options.max_file_bytes);
  add_seconds(record, "--max-file-duration", "begin another file after so long",
              options.max_file_duration, Range::positive);
  add_bytes("--max-total-size", "delete the oldest of the files when all together are larger",
            options.max_total_bytes);
  add_bytes("--quota",
            "delete the oldest of all recordings in the folder of --output before they "
            "are larger",
            options.quota_bytes);
}

void add_black_box(CLI::App* record, RecordOptions& options) {
  CLI::Option* const black_box =
      record->add_flag("--black-box", options.black_box,
                       "record only around triggers: a file for each incident, in the folder of "
                       "--output");
  add_seconds(record, "--before",
              "so long before a trigger, as far as the rings hold it (default: "
              "30s)",
              options.before, Range::not_negative)
      ->needs(black_box);
  add_seconds(record, "--after", "and so long after it (default: 10s)", options.after,
              Range::not_negative)
      ->needs(black_box);
  record
      ->add_option("--trigger", options.triggers,
                   "what begins an incident, beside `dssmctl trigger`: 'STREAM.FIELD > 3.5', "
                   "'stalled STREAM', 'crashed STREAM', 'clock HOST'; may be given several times")
      ->type_name("CONDITION")
      ->allow_extra_args(false);
  add_seconds(record, "--min-interval", "the same trigger not again within that (default: 1min)",
              options.min_interval, Range::not_negative)
      ->needs(black_box);
  add_seconds(record, "--max-incident", "triggers prolong an incident up to that (default: 5min)",
              options.max_incident, Range::positive)
      ->needs(black_box);
}

// Each is a file that other options do not fit.
void check_black_box(const RecordOptions& options) {
  if (!options.black_box) {
    require(options.triggers.empty(), "--trigger: only with --black-box");
    return;
  }
  require(!options.past && !options.duration && !options.until,
          "--black-box: it continues until Ctrl-C; leave out --past, --for and --until");
  require(options.max_file_bytes == 0 && options.max_file_duration == Duration::zero() &&
              options.max_total_bytes == 0,
          "--black-box: each incident is one file; limit all with --quota, and one with "
          "--max-incident");
  for (const std::string& trigger : options.triggers) {
    const Result<TriggerRule> rule = TriggerRule::parse(trigger);
    require(rule.has_value(), rule ? "" : rule.error().message);
  }
}

void check_record(RecordOptions& options) {
  require(!options.until || !options.until->back || *options.until->back == Duration::zero(),
          "--until: a time to come, as seconds since 1970 or ISO 8601");
  require(!options.until || options.until->back || options.until->time > WallClock::now(),
          "--until: that time is over; --for takes a duration");
  require(std::ranges::count(options.patterns, "") == 0,
          "PATTERN: it is empty, and no stream has an empty name; '*' fits all");
  require(options.repair.empty() || options.patterns.empty(),
          "--repair takes one file, and nothing else");
  require(!options.follow || options.past,
          "--follow: only with --past, without which it continues anyway");
  require(options.quota_bytes == 0 || options.quota_bytes >= RecordOptions::kMinQuotaBytes,
          fmt::format("--quota: at least {}, for all recordings in the folder; is a unit missing, "
                      "as in 20GiB?",
                      bytes_text(RecordOptions::kMinQuotaBytes)));
  require(options.quota_bytes == 0 || options.max_file_bytes <= options.quota_bytes / 2,
          "--max-file-size: at most half of --quota, because the newest file is not deleted");
  check_black_box(options);
}

void add_record(CLI::App& app, Parsed& parsed) {
  CLI::App* record = app.add_subcommand("record", "record streams of all hosts in an MCAP file");
  RecordOptions& options = add_options<RecordOptions>(record, parsed, check_record);
  record->footer(
      "Of a stream without a description the file has only bytes; `dssmctl describe STREAM` before "
      "the recording gives it fields.");
  record
      ->add_option("PATTERN", options.patterns,
                   "only streams whose NAME or NAME:ID one of these shell patterns fits (default: "
                   "all, also those to come)")
      ->type_name("");
  // One value each, so that PATTERN may follow.
  record
      ->add_option("--host", options.hosts,
                   "only the streams that HOST owns; may be given several times")
      ->type_name("HOST")
      ->allow_extra_args(false);
  record
      ->add_option("--type", options.types,
                   "only streams whose type this shell pattern fits; may be given several times")
      ->type_name("TYPE")
      ->allow_extra_args(false);
  record
      ->add_option("-o,--output", options.file,
                   "the file, or a folder for one (default: dssm_DATE-TIME.mcap)")
      ->type_name("FILE")
      ->check(
          CLI::Validator([](std::string& text) { return text.empty() ? "it is empty" : ""; }, ""));
  add_seconds(record, "--past", "what the rings hold of so long before now, then end", options.past,
              Range::positive);
  record->add_flag("--follow", options.follow, "with --past: and continue until Ctrl-C");
  CLI::Option* until = add_moment(record, "--until", "end at TIME", options.until);
  add_seconds(record, "--for", "end after so long", options.duration, Range::positive)
      ->excludes(until);
  record->add_option("--compression", options.compression, "lz4, zstd or none (default: lz4)")
      ->type_name("NAME")
      ->check(CLI::Validator(check_compression, ""));
  add_record_limits(record, options);
  add_black_box(record, options);
  // parse_command_line() puts the file's words in its place.
  record
      ->add_option_function<std::string>(
          "--config", [](const std::string&) {},
          "a TOML file with these options as keys, such as max_file_size, and PATTERN as streams")
      ->type_name("FILE");
  record
      ->add_option("--repair", options.repair,
                   "complete a recording that was not finished, in place; nothing is recorded")
      ->type_name("FILE");
}

void add_trigger(CLI::App& app, Parsed& parsed) {
  CLI::App* trigger =
      app.add_subcommand("trigger", "have the black boxes of all hosts record an incident");
  TriggerOptions& options =
      add_options<TriggerOptions>(trigger, parsed, [](const TriggerOptions& all) {
        require(!all.name.empty() && all.name.size() < sizeof(TriggerRequest::name),
                fmt::format("NAME has 1 to {} bytes", sizeof(TriggerRequest::name) - 1));
        require(all.reason.size() < sizeof(TriggerRequest::reason),
                fmt::format("--reason: at most {} bytes", sizeof(TriggerRequest::reason) - 1));
      });
  trigger
      ->add_option("NAME", options.name, "what happened, in a word: it is part of the file's name")
      ->required()
      ->type_name("");
  trigger->add_option("--reason", options.reason, "the same in a sentence, for people")
      ->type_name("TEXT");
}

void check_play(PlayOptions& options) {
  const auto patterns =
      std::stable_partition(options.patterns.begin(), options.patterns.end(),
                            [](const std::string& word) { return is_recording(word); });
  options.more_files.assign(options.patterns.begin(), patterns);
  options.patterns.erase(options.patterns.begin(), patterns);
  for (const std::string& mapping : options.mappings) {
    const std::size_t equals = mapping.find('=', 1);
    require(equals != std::string::npos && equals + 1 < mapping.size(),
            fmt::format("'{}' is not STREAM=NAME, as odometry=odometry_old", escaped(mapping)));
  }
}

void add_play(CLI::App& app, Parsed& parsed) {
  CLI::App* play = app.add_subcommand("play", "write the samples of a recording to streams");
  PlayOptions& options = add_options<PlayOptions>(play, parsed, check_play);
  play->add_option("FILE", options.file,
                   "the recording: a file, or the folder of its files; or a log of SSM")
      ->required()
      ->type_name("");
  play->add_option("PATTERN", options.patterns,
                   "more files (*.mcap, *.log, or a path), and: only streams whose NAME or NAME:ID "
                   "one of these shell patterns fits")
      ->type_name("");
  CLI::Option* const rate = add_parsed(
      play, "-r,--rate", "X", "how fast: 2 is twice as fast, -1 is backwards (default: 1)",
      [&options](const std::string& text) -> Result<void> {
        constexpr double kMin = 1e-3, kMax = 1e6;
        options.rate = DSSM_TRY(parse_real(text));
        if (std::fabs(options.rate) >= kMin && std::fabs(options.rate) <= kMax) return {};
        return Error{
            Errc::invalid_argument,
            fmt::format("'{}' is not a rate from 0.001 to 1000000, or from -1000000 to -0.001",
                        text)};
      });
  add_moment(
      play, "--from",
      "begin at TIME: so long after the recording's beginning (+2s) or before its end (-3s), "
      "seconds since 1970, or ISO 8601",
      options.from, parse_recorded_moment);
  add_moment(play, "--to", "end at TIME", options.to, parse_recorded_moment);
  CLI::Option* const paused =
      play->add_flag("-p,--start-paused", options.start_paused, "until Space is pressed");
  CLI::Option* const loop =
      play->add_flag("-l,--loop", options.loop, "again and again, until Ctrl-C");
  play->add_option("--map", options.mappings,
                   "STREAM, a shell pattern, is played as NAME; may be given several times")
      ->type_name("STREAM=NAME")
      ->allow_extra_args(false);
  play->add_flag("--on-hosts", options.on_hosts,
                 "on the hosts that the streams were on (default: all on this PC)");
  CLI::Option* const now = play->add_flag(
      "--now", options.now,
      "with the present times, not those of the recording; leaves the playback clock");
  play->add_flag("--this-host", options.this_host,
                 "only this PC's playback clock, not those of all hosts");
  play->add_flag("--force", options.force, "also to streams that another program writes");
  play->add_option("--lockstep", options.lockstep,
                   "start PROGRAM, and play as fast as it can take it, in the same order each "
                   "time; may be given several times")
      ->type_name("'PROGRAM ARGS'")
      ->allow_extra_args(false)
      ->excludes(rate)
      ->excludes(loop)
      ->excludes(now)
      ->excludes(paused);
}

void check_convert(ConvertOptions& options) {
  require(!options.more_files.empty(),
          "convert what to what? give IN OUT, as a.log b.log all.mcap");
  options.out = options.more_files.back();
  options.more_files.pop_back();
  const std::filesystem::path out = options.out;
  require(out.extension() == ".mcap" || out.extension() == ".log" || !out.has_extension() ||
              options.out.ends_with('/'),
          fmt::format("'{}' is neither a file *.mcap or *.log nor a folder", escaped(options.out)));
}

void add_convert(CLI::App& app, Parsed& parsed) {
  CLI::App* convert =
      app.add_subcommand("convert", "convert logs of SSM to recordings, and recordings to logs");
  ConvertOptions& options = add_options<ConvertOptions>(convert, parsed, check_convert);
  convert->add_option("IN", options.file, "a file *.log or *.mcap, or a folder of them")
      ->required()
      ->type_name("");
  convert
      ->add_option("OUT", options.more_files,
                   "more files to read, and at last what to write: a file *.mcap, a file *.log (of "
                   "one stream), or a folder for a log of each stream")
      ->required()
      ->type_name("");
  convert
      ->add_option(
          "--stream", options.patterns,
          "only streams whose NAME or NAME:ID this shell pattern fits; may be given several "
          "times")
      ->type_name("PATTERN")
      ->allow_extra_args(false);
  convert
      ->add_option("--compression", options.compression,
                   "of MCAP: lz4, zstd or none (default: lz4)")
      ->type_name("NAME")
      ->check(CLI::Validator(check_compression, ""));
}

void add_types(CLI::App& app, Parsed& parsed) {
  CLI::App* find = app.add_subcommand("find", "list the streams of a type");
  find->add_option("TYPE", add_options<FindOptions>(find, parsed).type,
                   "its name, or a shell pattern, as 'Scan*'")
      ->required()
      ->type_name("");
  CLI::App* show = app.add_subcommand("show", "show the fields of a type");
  show->add_option("TYPE", add_options<ShowOptions>(show, parsed).type, "its name")
      ->required()
      ->type_name("");
}

template <class VerbOptions>
void add_meter(CLI::App& app, Parsed& parsed, const std::string& name,
               const std::string& description) {
  CLI::App* meter = app.add_subcommand(name, description);
  VerbOptions& options = add_options<VerbOptions>(meter, parsed, [](const VerbOptions& all) {
    require(all.streams.size() <= kMaxWaitAny,
            fmt::format("at most {} streams at once", kMaxWaitAny));
  });
  meter
      ->add_option("STREAM", options.streams,
                   "one or several streams, as NAME, NAME:ID or NAME:ID@HOST")
      ->required()
      ->type_name("");
  add_whole(meter, "-w,--window", "N", "over the newest N samples (default: 10000)", options.window,
            2, kMaxWindow);
  add_whole(meter, "-n,--count", "N", "end after N reports", options.count, 1);
  add_interval(meter, "reports", options.interval);
  add_wait(meter, options.wait);
}

void add_create(CLI::App& app, Parsed& parsed) {
  CLI::App* create = app.add_subcommand("create", "create a stream");
  CreateOptions& options = add_options<CreateOptions>(create, parsed, [](const CreateOptions& all) {
    require(all.depth > 0 || all.life,
            "how much history? give --depth N, or --life DURATION and --cycle DURATION");
  });
  create->add_option("NAME", options.stream, "its name, as NAME, NAME:ID or NAME:ID@HOST")
      ->required()
      ->type_name("");
  add_whole(create, "--size", "BYTES", "bytes per sample", options.payload_bytes, 1,
            kMaxPayloadBytes)
      ->required();
  CLI::Option* depth = add_whole(create, "--depth", "N", "number of slots in the ring",
                                 options.depth, kMinDepth, kMaxDepth);
  CLI::Option* life = add_seconds(create, "--life", "how much history to keep, with --cycle",
                                  options.life, Range::positive);
  life->excludes(depth);
  CLI::Option* cycle = add_seconds(create, "--cycle", "expected time between two samples",
                                   options.cycle, Range::positive);
  life->needs(cycle);
  create->add_option("--type", options.type, "name of the samples' type")->type_name("NAME");
  add_parsed(
      create, "--align", "BYTES", "alignment of a sample (default: what fits its size)",
      [&options](const std::string& text) -> Result<void> {
        const std::uint64_t value = DSSM_TRY(parse_whole(text, 1, 64));
        if (!std::has_single_bit(value)) {
          return Error{Errc::invalid_argument, fmt::format("'{}' is not a power of two", text)};
        }
        options.alignment_bytes = static_cast<std::uint32_t>(value);
        return {};
      });
}

void add_rm(CLI::App& app, Parsed& parsed) {
  CLI::App* rm = app.add_subcommand("rm", "remove streams");
  RmOptions& options = add_options<RmOptions>(rm, parsed);
  rm->add_option("STREAM", options.streams, kStreamHelp)->required()->type_name("");
}

void add_describe(CLI::App& app, Parsed& parsed) {
  CLI::App* describe =
      app.add_subcommand("describe", "give a stream the fields of a program's type");
  DescribeOptions& options = add_options<DescribeOptions>(describe, parsed);
  CLI::Option* stream =
      describe->add_option("STREAM", options.stream,
                           std::string(kStreamHelp) + "; none: all streams that are not described");
  stream->type_name("");
  describe
      ->add_option("--from", options.from,
                   "a program, library, object file or separate debug file with debug information "
                   "(-g); default: the programs that have the stream open")
      ->type_name("FILE")
      ->needs(stream);
  describe
      ->add_option("--type", options.type,
                   "the type there; default: the one that the stream names, or that fits")
      ->type_name("TYPE")
      ->needs(stream);
  describe->add_flag("--force", options.force, "replace the type and fields that the stream has")
      ->needs(stream);
}

void add_rights(CLI::App& app, Parsed& parsed) {
  CLI::App* rights = app.add_subcommand("rights", "show who may do what with a stream");
  add_stream(rights, add_options<RightsOptions>(rights, parsed).stream);
}

void add_property(CLI::App& app, Parsed& parsed) {
  CLI::App* property = app.add_subcommand("property", "show or set a stream's property");
  property->require_subcommand(1);
  CLI::App* get = property->add_subcommand("get", "write the property's bytes to a file");
  PropertyOptions& to = add_options<PropertyGetOptions>(get, parsed);
  add_stream(get, to.stream);
  get->add_option("FILE", to.file, "where to; - or nothing: standard output")->type_name("");
  CLI::App* set = property->add_subcommand("set", "replace the property by a file's bytes");
  PropertyOptions& from = add_options<PropertySetOptions>(set, parsed);
  add_stream(set, from.stream);
  set->add_option("FILE", from.file, "where from; - or nothing: standard input")->type_name("");
}

void add_playback(CLI::App& app, Parsed& parsed) {
  CLI::App* playback = app.add_subcommand("playback", "show or change the PC's playback clock");
  playback->require_subcommand(0, 1);
  const auto add = [&](const char* name, const char* description) -> PlaybackOptions& {
    return add_options<PlaybackOptions>(playback->add_subcommand(name, description), parsed);
  };
  add_options<PlaybackOptions>(playback, parsed);
  add("show", "show the clock");
  CLI::App* set = playback->add_subcommand("set", "change the clock");
  PlaybackOptions& changed =
      add_options<PlaybackOptions>(set, parsed, [](const PlaybackOptions& all) {
        require(all.offset_s || all.speed || all.time,
                "what shall change? give --offset SECONDS, --speed X or --time TIME");
      });
  CLI::Option* offset =
      add_real(set, "--offset", "SECONDS", "its offset from speed * real time", changed.offset_s);
  add_real(set, "--speed", "X", "how fast it runs: 1 as real time, 0 not at all, -1 backwards",
           changed.speed);
  add_moment(set, "--time",
             "its time now: seconds since 1970, ISO 8601, now, or so long before now (-3s)",
             changed.time)
      ->excludes(offset);
  add("pause", "stop the clock").paused = true;
  add("resume", "let it run again").paused = false;
  add("reset", "back to real time").reset = true;
}

// Where the result goes that is PEM text.
void add_out(CLI::App* verb, std::string& out) {
  verb->add_option("--out", out, "the file to write to (default: standard output)")
      ->type_name("FILE");
}

// One of the verbs that need the CA.
template <class VerbOptions>
VerbOptions& add_ca_verb(CLI::App* pki, Parsed& parsed, const char* name, const char* description) {
  CLI::App* verb = pki->add_subcommand(name, description);
  VerbOptions& options = add_options<VerbOptions>(verb, parsed);
  verb->add_option("--ca", options.ca, "the CA's folder (default: /etc/dssm/ca)")->type_name("DIR");
  return options;
}

void add_days(CLI::App* verb, std::int64_t& days) {
  add_whole(verb, "--days", "N", "how long it is valid (default: 730)", days, 1, kMaxDays);
}

void add_credentials(CLI::App* verb, std::string& credentials) {
  verb->add_option("--credentials", credentials,
                   "the folder of key and certificates (default: /etc/dssm/credentials)")
      ->type_name("DIR");
}

void add_pki_ca(CLI::App* pki, Parsed& parsed) {
  auto& init = add_ca_verb<PkiInitOptions>(pki, parsed, "init", "make the CA of a vehicle");
  pki->get_subcommand("init")
      ->add_option("--name", init.vehicle, "the vehicle's name (default: that of this host)")
      ->type_name("VEHICLE");

  auto& issue = add_ca_verb<PkiIssueOptions>(pki, parsed, "issue",
                                             "sign a request: print a bundle to install");
  CLI::App* verb = pki->get_subcommand("issue");
  verb->add_option("REQUEST", issue.request, "its file; -: standard input")
      ->required()
      ->type_name("");
  add_days(verb, issue.days);
  add_out(verb, issue.out);

  auto& renew = add_ca_verb<PkiRenewOptions>(
      pki, parsed, "renew", "issue again, for the same key: print a bundle to install");
  verb = pki->get_subcommand("renew");
  verb->add_option("NAME", renew.name, "host, program or serial number")->required()->type_name("");
  add_days(verb, renew.days);
  add_out(verb, renew.out);

  auto& revoke = add_ca_verb<PkiRevokeOptions>(
      pki, parsed, "revoke", "withdraw certificates: print a revocation list to install");
  verb = pki->get_subcommand("revoke");
  verb->add_option("NAME", revoke.name, "host, program or serial number")
      ->required()
      ->type_name("");
  add_out(verb, revoke.out);
}

void add_pki(CLI::App& app, Parsed& parsed) {
  CLI::App* pki = app.add_subcommand("pki", "make and install certificates for TLS");
  pki->require_subcommand(1);
  add_pki_ca(pki, parsed);

  CLI::App* request = pki->add_subcommand("request", "make a key, and print a request to sign");
  auto& asked = add_options<PkiRequestOptions>(request, parsed);
  add_credentials(request, asked.credentials);
  CLI::Option* host = request->add_option("--host", asked.host, "for a host (default: this one)")
                          ->type_name("NAME");
  request->add_option("--program", asked.program, "for programs on a PC without dssmd")
      ->type_name("NAME")
      ->excludes(host);
  add_out(request, asked.out);

  CLI::App* install = pki->add_subcommand("install", "check a bundle, and put it in place");
  auto& installed = add_options<PkiInstallOptions>(install, parsed);
  install->add_option("BUNDLE", installed.bundle, "its file; -: standard input")
      ->required()
      ->type_name("");
  add_credentials(install, installed.credentials);

  CLI::App* show = pki->add_subcommand("show", "what certificates there are, and their state");
  auto& shown = add_options<PkiShowOptions>(show, parsed);
  show->add_option("PATH", shown.path,
                   "a folder of credentials or of a CA, or a PEM file; -: standard input (default: "
                   "/etc/dssm/credentials)")
      ->type_name("");
}

void add_all(CLI::App& app, Parsed& parsed) {
  // Global options may also follow the verb; verbs made after these lines inherit both.
  app.fallthrough();
  const auto formatter = std::make_shared<HelpFormatter>();
  formatter->label("SUBCOMMAND", "VERB");
  app.formatter(formatter);
  app.footer(
      "--socket, --json, --iso and --wide may precede or follow the verb; 'dssmctl help VERB' "
      "explains it, and dssmctl(1) all.");
  app.require_subcommand(1);
  app.set_help_flag("-h,--help", "show this help and end");
  app.set_version_flag("--version", "dssmctl " DSSM_VERSION, "show the version and end");
  app.add_option("--socket", parsed.common.socket_path,
                 "where dssmd listens (default: $DSSM_SOCKET, else /run/dssm/dssmd.sock)")
      ->type_name("PATH");
  app.add_flag("--json", parsed.common.json, "output for programs");
  app.add_flag("--iso", parsed.common.iso,
               "times as ISO 8601 in UTC, not as seconds since 1970 (JSON has nanoseconds)");
  app.add_flag("--wide", parsed.common.wide,
               "tables with all columns, also where the terminal is narrower");
  add_ls(app, parsed);
  add_hosts(app, parsed);
  add_nodes(app, parsed);
  add_top(app, parsed);
  add_graph(app, parsed);
  add_clock(app, parsed);
  add_options<DoctorOptions>(
      app.add_subcommand("doctor", "check for what usually goes wrong, and how to fix it"), parsed);
  add_options<MetricsOptions>(
      app.add_subcommand("metrics", "what dssmd knows, as OpenMetrics text for Prometheus"), parsed,
      [](const MetricsOptions& all) {
        require(!all.json,
                "--json: metrics are OpenMetrics text; `dssmctl ls --json` and `dssmctl "
                "hosts --json` have the same as JSON");
      });
  add_ping(app, parsed);
  add_info(app, parsed);
  add_echo(app, parsed);
  add_plot(app, parsed);
  add_pub(app, parsed);
  add_record(app, parsed);
  add_trigger(app, parsed);
  add_play(app, parsed);
  add_convert(app, parsed);
  add_types(app, parsed);
  add_meter<HzOptions>(app, parsed, "hz", "how often samples come");
  add_meter<BwOptions>(app, parsed, "bw", "how many bytes come");
  add_meter<DelayOptions>(app, parsed, "delay", "how old samples are when they arrive");
  add_create(app, parsed);
  add_describe(app, parsed);
  add_rm(app, parsed);
  add_rights(app, parsed);
  add_property(app, parsed);
  add_playback(app, parsed);
  add_pki(app, parsed);
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

std::vector<std::string> verbs_of(const CLI::App& app) {
  std::vector<std::string> verbs;
  for (const CLI::App* verb : app.get_subcommands({})) verbs.push_back(verb->get_name());
  return verbs;
}

// What is called otherwise elsewhere: by people, ROS 2, SSM, or this program's earlier versions.
// Where two words name it, those of one word follow.
constexpr std::pair<std::string_view, std::string_view> kOtherNames[] = {{"list", "ls"},
                                                                         {"topic", "ls"},
                                                                         {"topics", "ls"},
                                                                         {"streams", "ls"},
                                                                         {"monitor", "top"},
                                                                         {"watch", "ls --watch"},
                                                                         {"cat", "echo"},
                                                                         {"read", "echo"},
                                                                         {"publish", "pub"},
                                                                         {"write", "pub"},
                                                                         {"rate", "hz"},
                                                                         {"bandwidth", "bw"},
                                                                         {"latency", "delay"},
                                                                         {"describe", "info"},
                                                                         {"stat", "info"},
                                                                         {"type", "info"},
                                                                         {"interface list", "find"},
                                                                         {"interface", "show"},
                                                                         {"delete", "rm"},
                                                                         {"remove", "rm"},
                                                                         {"new", "create"},
                                                                         {"status", "doctor"},
                                                                         {"check", "doctor"},
                                                                         {"wtf", "doctor"},
                                                                         {"peers", "hosts"},
                                                                         {"host", "hosts"},
                                                                         {"node", "nodes"},
                                                                         {"processes", "nodes"},
                                                                         {"ps", "nodes"},
                                                                         {"param", "property"},
                                                                         {"bag info", "info FILE"},
                                                                         {"bag play", "play"},
                                                                         {"bag", "record"},
                                                                         {"rec", "record"},
                                                                         {"logger", "record"},
                                                                         {"replay", "play"},
                                                                         {"player", "play"},
                                                                         {"time", "clock"},
                                                                         {"version", "--version"},
                                                                         {"incident", "trigger"}};

// "ls", for a verb that `app` has not; `next` is the word after it. Empty: nothing is like it.
std::string meant_verb(const CLI::App& app, std::string_view word, std::string_view next) {
  const std::vector<std::string> verbs = verbs_of(app);
  // ros2 topic hz, ros2 topic list
  if (word == "topic" && !next.empty()) {
    if (std::find(verbs.begin(), verbs.end(), next) != verbs.end()) return std::string(next);
    if (std::string meant = meant_verb(app, next, ""); !meant.empty()) return meant;
  }
  const std::string both = fmt::format("{} {}", word, next);
  for (const auto& [other, name] : kOtherNames) {
    if (other == word || other == both) return std::string(name);
  }
  const std::vector<std::string> similar = similar_names(word, verbs);
  return similar.empty() ? "" : similar.front();
}

// The error of a word that is not a verb of `at`.
std::string no_verb(const CLI::App& at, const std::string& word, const std::string& next) {
  std::string meant;
  if (!at.get_parent()) {
    if (word == "service" || word == "action") {
      return fmt::format("there is no verb '{}' (DSSM has only streams, no {}s)", word, word);
    }
    meant = meant_verb(at, word, next);
  } else if (std::vector<std::string> similar = similar_names(word, verbs_of(at));
             !similar.empty()) {
    meant = std::move(similar.front());
  }
  return fmt::format("there is no verb '{}'{}", word,
                     meant.empty() ? "" : fmt::format(" (did you mean '{}'?)", meant));
}

// The words that are no options, nor --socket's value.
std::vector<std::string> plain_words(const std::vector<const char*>& words) {
  std::vector<std::string> plain;
  for (std::size_t i = 1; i < words.size(); ++i) {
    const std::string_view word = words[i];
    if (word == "--socket") ++i;
    if (!word.starts_with('-')) plain.emplace_back(word);
  }
  return plain;
}

CommandLine usage_error(const CLI::App& app, const std::string& error) {
  const std::string verb = verb_name(app);
  return {std::nullopt,
          fmt::format("dssmctl: {}{}{}; see 'dssmctl {}{}--help'\n", verb, verb.empty() ? "" : ": ",
                      escaped_message(error), verb, verb.empty() ? "" : " "),
          false};
}

// Replaces `--config FILE` of `record` by the words of that file, which `configured` keeps.
Result<void> expand_config(std::vector<const char*>& words, std::vector<std::string>& configured) {
  constexpr std::string_view kOption = "--config";
  if (std::none_of(words.begin(), words.end(),
                   [](const char* word) { return word == std::string_view("record"); })) {
    return {};
  }
  for (auto word = words.begin(); word != words.end(); ++word) {
    const std::string_view text = *word;
    const bool is_joined = text.starts_with("--config=");
    if (!is_joined && (text != kOption || word + 1 == words.end())) continue;
    const std::string path(is_joined ? text.substr(kOption.size() + 1) : word[1]);
    configured = DSSM_TRY(config_words(path));
    word = words.erase(word, word + (is_joined ? 1 : 2));
    std::vector<const char*> pointers(configured.size());
    std::ranges::transform(configured, pointers.begin(), &std::string::c_str);
    words.insert(word, pointers.begin(), pointers.end());
    return {};
  }
  return {};
}

}  // namespace

CommandLine parse_command_line(int argc, const char* const* argv) {
  // `help VERB` is `VERB --help`.
  std::vector<const char*> words(argv, argv + argc);
  if (argc > 1 && std::string_view(argv[1]) == "help") {
    words.erase(words.begin() + 1);
    words.push_back("--help");
  }
  // What --config names, in its place: what else the command line says is beside it.
  std::vector<std::string> configured;
  if (Result<void> read = expand_config(words, configured); !read) {
    return {std::nullopt, fmt::format("dssmctl: {}\n", escaped_message(read.error().message)),
            false};
  }
  Parsed parsed;
  CLI::App app("Show and manage streams of sensor samples, on this PC and on others.", "dssmctl");
  add_all(app, parsed);
  if (argc < 2) return {std::nullopt, app.help(), false};
  // CLI11 would take the next word for the verb.
  const std::vector<std::string> plain = plain_words(words), verbs = verbs_of(app);
  if (!plain.empty() && std::find(verbs.begin(), verbs.end(), plain.front()) == verbs.end()) {
    return usage_error(app, no_verb(app, plain.front(), plain.size() > 1 ? plain[1] : ""));
  }
  try {
    app.parse(static_cast<int>(words.size()), words.data());
  } catch (const CLI::CallForHelp&) {
    return {std::nullopt, app.help(), true};
  } catch (const CLI::CallForVersion& version) {
    return {std::nullopt, version.what() + std::string("\n"), true};
  } catch (const CLI::ParseError& error) {
    const std::vector<std::string> rest = app.remaining(true);
    if (rest.empty()) {
      const bool lacks_verb =
          innermost(app).get_require_subcommand_min() > 0 &&
          innermost(app).get_subcommands().empty() &&
          error.get_exit_code() == static_cast<int>(CLI::ExitCodes::RequiredError);
      return usage_error(app, lacks_verb ? "a verb is missing" : error.what());
    }
    if (std::find(configured.begin(), configured.end(), rest.front()) != configured.end()) {
      return usage_error(app, fmt::format("the configuration has a key that is not an option: '{}'",
                                          rest.front()));
    }
    const std::string word = fmt::format("'{}'", rest.front());
    if (rest.front().starts_with('-')) return usage_error(app, "there is no option " + word);
    if (innermost(app).get_subcommands({}).empty()) {
      return usage_error(app, word + " is one word too many");
    }
    return usage_error(app, no_verb(innermost(app), rest.front(), ""));
  }
  if (!parsed.options) return usage_error(app, "a verb is missing");  // CLI11 requires one
  std::visit([&](CommonOptions& options) { options.verb_name = verb_name(app); }, *parsed.options);
  return {std::move(parsed.options), {}, true};
}

}  // namespace dssm::ctl
