// SPDX-License-Identifier: Apache-2.0
//
// The command line: one struct of options per verb, checked as far as that is possible without
// asking dssmd; and the verbs themselves, which take these.
#pragma once

#include <cstdint>
#include <dssm/result.hpp>
#include <dssm/stream.hpp>
#include <dssm/time.hpp>
#include <optional>
#include <string>
#include <variant>
#include <vector>

#include "client/dssmctl/output.hpp"
#include "client/dssmctl/text.hpp"

namespace dssm::ctl {

// Of all verbs.
struct CommonOptions {
  std::string verb_name;    // as typed, "property get": for messages
  std::string socket_path;  // empty: the default
  bool json = false;
  bool iso = false;   // times for people as ISO 8601
  bool wide = false;  // tables with all columns, however narrow the terminal is
};

struct LsOptions : CommonOptions {
  std::string pattern;             // only streams whose names fit; empty: all
  bool own = false;                // only this host's
  std::vector<std::string> hosts;  // only theirs; empty: of all
  bool watch = false;
  bool names = false;
  std::string sort = "created";
  bool reverse = false;
};

struct HostsOptions : CommonOptions {
  bool names = false;
  bool watch = false;
};

struct NodesOptions : CommonOptions {
  std::string pattern;             // only processes whose program's name fits; empty: all
  std::vector<std::string> hosts;  // only theirs; empty: of all
};

enum class TopView : unsigned char { streams, hosts, programs };

struct TopOptions : CommonOptions {
  std::string pattern;              // a shell pattern or a part of the name; empty: all
  TopView view = TopView::streams;  // that is shown first
  std::string sort;                 // a key of that view; empty: as dssmd lists it
  bool reverse = false;
  Duration interval = std::chrono::seconds(1);
  std::optional<std::uint64_t> count;
};

struct GraphOptions : CommonOptions {
  std::string out;     // the file to write; empty: standard output
  std::string format;  // of that file, by its name: "dot", "svg", "png"
};

struct ClockOptions : CommonOptions {
  bool watch = false;
  bool matrix = false;                 // a row per pair of hosts
  std::optional<std::uint64_t> table;  // number of readings
  std::optional<Duration> wait;
};

struct DoctorOptions : CommonOptions {};
struct MetricsOptions : CommonOptions {};

struct PingOptions : CommonOptions {
  std::string host;
  std::optional<std::uint64_t> count;
  Duration interval = std::chrono::seconds(1);
};

struct InfoOptions : CommonOptions {
  std::string stream;  // or a recording's path; empty: about dssmd itself
  bool watch = false;
};

// Of verbs that read a stream.
struct ReadingOptions : CommonOptions {
  Duration wait{};                     // how long for the stream to appear
  std::optional<std::uint64_t> count;  // of samples or reports
};

struct EchoOptions : ReadingOptions {
  std::string stream;
  std::optional<Moment> at;  // counts back from the newest sample
  bool last = false;
  bool csv = false;
  bool full = false;
  std::vector<std::string> fields;
};

struct PlotOptions : ReadingOptions {
  std::vector<std::string> targets;  // STREAM.FIELD
  Duration span = std::chrono::seconds(10);
  std::optional<Duration> duration;
  std::string out;  // the file to write, *.svg or *.png; empty: the terminal
};

struct PubOptions : CommonOptions {
  std::string stream;
  std::vector<std::string> assignments;  // FIELD=VALUE
  std::optional<Duration> period;
  std::optional<std::uint64_t> count;
  bool from_stdin = false;
  bool times = false;
};

struct RecordOptions : CommonOptions {
  std::vector<std::string> patterns, hosts, types;  // empty: all
  std::string file;    // or a folder; empty: a name made of the time, in the working directory
  std::string repair;  // the file to repair, instead of recording
  std::optional<Duration> past, duration;
  std::optional<Moment> until;
  bool follow = false;
  std::string compression = "lz4";
  std::uint64_t max_file_bytes = 0, max_total_bytes = 0;  // 0: no limit
  Duration max_file_duration{};                           // 0: no limit
  // Less is probably a number without its unit, and would delete all earlier recordings.
  static constexpr std::uint64_t kMinQuotaBytes = 64U << 10;
  std::uint64_t quota_bytes = 0;  // of all recordings in the folder; 0: none
  // Of the black box.
  bool black_box = false;
  std::vector<std::string> triggers;  // as TriggerRule::parse() reads them
  Duration before = std::chrono::seconds(30), after = std::chrono::seconds(10);
  Duration min_interval = std::chrono::minutes(1), max_incident = std::chrono::minutes(5);
};

struct TriggerOptions : CommonOptions {
  std::string name, reason;
};

struct PlayOptions : CommonOptions {
  std::string file;  // or the folder of one recording
  std::vector<std::string> more_files;
  std::vector<std::string> patterns;  // of the recording's streams; empty: all
  std::vector<std::string> mappings;  // PATTERN=NAME
  double rate = 1;                    // negative: backwards
  bool start_paused = false, this_host = false;
  std::optional<Moment> from, to;     // offsets are from the recording's ends
  std::vector<std::string> lockstep;  // commands; empty: by the clock
  bool loop = false, now = false, on_hosts = false, force = false;
};

struct ConvertOptions : CommonOptions {
  std::string file;  // or a folder
  std::vector<std::string> more_files;
  std::string out;                    // *.mcap, *.log, or a folder for logs
  std::vector<std::string> patterns;  // of streams; empty: all
  std::string compression = "lz4";
};

struct FindOptions : CommonOptions {
  std::string type;  // a shell pattern
};
struct ShowOptions : CommonOptions {
  std::string type;
};

// Of hz, bw and delay.
struct MeterOptions : ReadingOptions {
  std::vector<std::string> streams;
  std::uint64_t window = 10'000;
  Duration interval = std::chrono::seconds(1);
};
struct HzOptions : MeterOptions {};
struct BwOptions : MeterOptions {};
struct DelayOptions : MeterOptions {};

struct CreateOptions : CommonOptions {
  std::string stream;
  std::uint64_t payload_bytes = 0;
  std::uint32_t alignment_bytes = 0;  // 0: the greatest that a type of this size may have
  std::uint64_t depth = 0;            // 0: `life` and `cycle` are given
  std::optional<Duration> life, cycle;
  std::string type;
};

struct DescribeOptions : CommonOptions {
  std::string stream;  // empty: all that are not described
  std::string from;    // a file; empty: the programs that have the stream open
  std::string type;    // empty: the stream's, or one that fits
  bool force = false;  // replaces what the stream has
};

struct RmOptions : CommonOptions {
  std::vector<std::string> streams;
};

struct RightsOptions : CommonOptions {
  std::string stream;
};

struct PropertyOptions : CommonOptions {
  std::string stream;
  std::string file = "-";
};
struct PropertyGetOptions : PropertyOptions {};
struct PropertySetOptions : PropertyOptions {};

// What to change of the playback clock; nothing: show it.
struct PlaybackOptions : CommonOptions {
  std::optional<bool> paused;
  bool reset = false;
  std::optional<double> offset_s, speed;
  std::optional<Moment> time;  // counts back from now
};

// Of dssmctl pki. Folders are those of a CA and of credentials; out: "-" or empty for standard
// output, else a file.
struct PkiCaOptions : CommonOptions {
  std::string ca = "/etc/dssm/ca";
  std::string out;
};
struct PkiInitOptions : PkiCaOptions {
  std::optional<std::string> vehicle;  // none: the name of this host
};
struct PkiIssueOptions : PkiCaOptions {
  std::string request;  // file
  std::int64_t days = 730;
};
struct PkiRenewOptions : PkiCaOptions {
  std::string name;
  std::int64_t days = 730;
};
struct PkiRevokeOptions : PkiCaOptions {
  std::string name;
};

inline constexpr const char* kCredentialsFolder = "/etc/dssm/credentials";
struct PkiRequestOptions : CommonOptions {
  std::string credentials = kCredentialsFolder;
  std::optional<std::string> host, program;  // neither: this host
  std::string out;
};
struct PkiInstallOptions : CommonOptions {
  std::string bundle;  // file
  std::string credentials = kCredentialsFolder;
};
struct PkiShowOptions : CommonOptions {
  std::string path = kCredentialsFolder;
};

using Options =
    std::variant<LsOptions, HostsOptions, NodesOptions, TopOptions, GraphOptions, ClockOptions,
                 DoctorOptions, MetricsOptions, PlotOptions, PingOptions, InfoOptions, EchoOptions,
                 PubOptions, RecordOptions, TriggerOptions, PlayOptions, ConvertOptions,
                 FindOptions, ShowOptions, HzOptions, BwOptions, DelayOptions, CreateOptions,
                 DescribeOptions, RmOptions, RightsOptions, PropertyGetOptions, PropertySetOptions,
                 PlaybackOptions, PkiInitOptions, PkiRequestOptions, PkiIssueOptions,
                 PkiInstallOptions, PkiRenewOptions, PkiRevokeOptions, PkiShowOptions>;

// Either options to work with, or a text that ends the program at once: help and version on
// standard output, an error on standard error.
struct CommandLine {
  std::optional<Options> options;
  std::string text;
  bool ok = true;  // text is what was asked for
};

CommandLine parse_command_line(int argc, const char* const* argv);

// --- the verbs, one source per group of them. Each connects (those of pki do not), works, and adds
// its output to `out`; main() flushes and turns a failure into an exit status.

Result<void> run(const LsOptions& options, Output& out);
Result<void> run(const HostsOptions& options, Output& out);
Result<void> run(const NodesOptions& options, Output& out);
Result<void> run(const TopOptions& options, Output& out);
Result<void> run(const GraphOptions& options, Output& out);
Result<void> run(const ClockOptions& options, Output& out);
Result<void> run(const DoctorOptions& options, Output& out);
Result<void> run(const MetricsOptions& options, Output& out);
Result<void> run(const PlotOptions& options, Output& out);
Result<void> run(const PingOptions& options, Output& out);
Result<void> run(const InfoOptions& options, Output& out);
Result<void> run(const EchoOptions& options, Output& out);
Result<void> run(const PubOptions& options, Output& out);
Result<void> run(const RecordOptions& options, Output& out);
Result<void> run(const TriggerOptions& options, Output& out);
Result<void> run(const PlayOptions& options, Output& out);
Result<void> run(const ConvertOptions& options, Output& out);
Result<void> run(const FindOptions& options, Output& out);
Result<void> run(const ShowOptions& options, Output& out);
Result<void> run(const HzOptions& options, Output& out);
Result<void> run(const BwOptions& options, Output& out);
Result<void> run(const DelayOptions& options, Output& out);
Result<void> run(const CreateOptions& options, Output& out);
Result<void> run(const DescribeOptions& options, Output& out);
Result<void> run(const RmOptions& options, Output& out);
Result<void> run(const RightsOptions& options, Output& out);
Result<void> run(const PropertyGetOptions& options, Output& out);
Result<void> run(const PropertySetOptions& options, Output& out);
Result<void> run(const PlaybackOptions& options, Output& out);
Result<void> run(const PkiInitOptions& options, Output& out);
Result<void> run(const PkiRequestOptions& options, Output& out);
Result<void> run(const PkiIssueOptions& options, Output& out);
Result<void> run(const PkiInstallOptions& options, Output& out);
Result<void> run(const PkiRenewOptions& options, Output& out);
Result<void> run(const PkiRevokeOptions& options, Output& out);
Result<void> run(const PkiShowOptions& options, Output& out);

}  // namespace dssm::ctl
