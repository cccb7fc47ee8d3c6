// SPDX-License-Identifier: Apache-2.0
//
// dssmctl record: streams into an MCAP file, until Ctrl-C or a given time.
#include <fmt/format.h>

#include <algorithm>
#include <filesystem>
#include <utility>

#include "client/dssmctl/black_box.hpp"
#include "client/dssmctl/black_box_streams.hpp"
#include "client/dssmctl/describe_stream.hpp"
#include "client/dssmctl/open_stream.hpp"
#include "client/dssmctl/options.hpp"
#include "client/dssmctl/output.hpp"
#include "client/dssmctl/recorder.hpp"
#include "client/dssmctl/recording_folder.hpp"
#include "client/dssmctl/recording_info.hpp"
#include "client/dssmctl/text.hpp"
#include "core/base/try.hpp"

namespace dssm::ctl {
namespace {

// By then the streams that there are could have been opened.
constexpr Duration kFirstNoticeTime = std::chrono::seconds(1);
constexpr std::size_t kMaxNamedStreams = 20;  // streams in one notice

// A folder is not created: it may be a disk that is not mounted, or a wrong name.
Result<void> check_folder(const std::filesystem::path& folder) {
  std::error_code ignored;
  if (folder.empty() ||
      std::filesystem::status(folder, ignored).type() != std::filesystem::file_type::not_found) {
    return {};
  }
  return Error{Errc::not_found,
               fmt::format("record in '{0}': there is no such folder; `mkdir -p '{0}'` creates it",
                           escaped(folder.string()))};
}

bool is_folder(const std::string& path) {
  std::error_code ignored;
  return std::filesystem::is_directory(path, ignored);
}

// What needs a folder: recordings with names of their own are counted and deleted there.
Result<void> check_output(const RecordOptions& options) {
  const bool is_limited = options.black_box || options.quota_bytes > 0;
  const std::filesystem::path output = options.file;
  DSSM_TRY(check_folder(options.black_box || options.file.ends_with('/') ? output
                                                                         : output.parent_path()));
  if (!is_limited || options.file.empty() || is_folder(options.file)) return {};
  return Error{
      Errc::invalid_argument,
      fmt::format(
          "{} names its recordings itself, in the folder of --output; '{}' is no folder{}",
          options.black_box ? "--black-box" : "--quota", escaped(options.file),
          options.black_box ? "" : " (--max-total-size limits the files of one recording)")};
}

std::filesystem::path file_of(const RecordOptions& options) {
  const std::string name = recording_name(WallClock::now());
  if (options.file.empty()) return name;
  return is_folder(options.file) ? std::filesystem::path(options.file) / name
                                 : std::filesystem::path(options.file);
}

// Has a recording of this PC's streams what `echo` shows of those that are not described.
void add_types_of_programs(RecorderPlan& plan, Session& session) {
  constexpr Duration kMaxTime = std::chrono::seconds(1);
  std::vector<StreamInfo> streams = session.list_own_streams().value_or(std::vector<StreamInfo>{});
  std::erase_if(streams, [&](const StreamInfo& stream) { return !plan.takes(stream); });
  plan.types_of_programs = obvious_types_of_programs(session, streams, kMaxTime);
  if (plan.types_of_programs.empty()) return;
  std::vector<std::string> names;
  for (const auto& [stream, type] : plan.types_of_programs) names.push_back(escaped(stream.first));
  print_error(
      fmt::format("dssmctl: record: with fields from the debug information of their programs: {}\n",
                  list_text(names, kMaxNamedStreams)));
}

// Records until it is to end, and says how it goes: on a terminal in a line that is redrawn.
class RecordingRun {
 public:
  RecordingRun(const RecordOptions& options, std::filesystem::path file, Recorder& recorder,
               RecordingFolder& folder, Output& out)
      : options_(options),
        file_(std::move(file)),
        recorder_(recorder),
        folder_(folder),
        out_(out),
        end_(options.duration ? deadline_in(*options.duration) : kNever) {}

  // Until Ctrl-C, in time, or because it cannot go on. The file is complete in any case.
  Result<void> run() {
    Result<void> recorded;
    do {
      recorded = recorder_.take();
      if (recorded) recorded = keep_quota();
      report();
    } while (recorded && !is_over() && out_.sleep_until(std::min(recorder_.next_take(), end_)));
    Result<void> finished = recorder_.finish();
    if (finished) finished = keep_quota();
    report_notices();
    report_unused();
    report_undescribed();
    out_.clear_line();
    print_summary();
    return recorded ? finished : recorded;
  }

 private:
  Result<void> keep_quota() {
    if (options_.quota_bytes == 0) return {};
    return folder_.make_room(recorder_.progress().file_bytes);
  }

  bool is_over() {
    const MonoTime now = MonoClock::now();
    if (now >= end_ || (options_.until && WallClock::now() >= options_.until->time)) return true;
    if (!options_.past || options_.duration || options_.until || options_.follow) return false;
    if (recorder_.has_past()) return true;
    if (!recorder_.is_past_late()) return false;
    notice("not all of the past has come; is another host slow or silent? See `dssmctl hosts`");
    return true;
  }

  void report() {
    report_notices();
    if (MonoClock::now() - started_ > kFirstNoticeTime) report_unused();
    if (options_.json) return;
    out_.redraw_line(
        [&] { return fmt::format("{}: {}", escaped(file_.string()), progress_text(recorder_)); });
  }

  void report_notices() {
    for (const std::string& text : recorder_.take_notices()) notice(text);
    for (const std::string& text : folder_.take_notices()) notice(text);
  }

  // Once: a name with a mistake in it would else be missed when the recording is needed.
  void report_unused() {
    if (std::exchange(has_named_unused_, true)) return;
    const std::vector<std::string> unused = recorder_.unused_patterns();
    if (unused.empty()) return;
    const std::string of_hosts =
        options_.hosts.empty() ? "" : fmt::format(" of {}", escaped(list_text(options_.hosts)));
    notice(options_.patterns.empty()
               ? fmt::format("no stream{} fits so far", of_hosts)
               : fmt::format("no stream{} fits {} so far", of_hosts, list_text(unused)));
  }

  void report_undescribed() {
    const std::vector<std::string> names = recorder_.streams_without_fields();
    if (names.empty()) return;
    notice(
        fmt::format("without descriptions, so only with their bytes: {}; `dssmctl describe "
                    "STREAM` before a recording gives a stream fields",
                    list_text(names, kMaxNamedStreams)));
  }

  void notice(const std::string& text) {
    out_.clear_line();
    print_error(fmt::format("dssmctl: record: {}\n", text));
  }

  void print_summary() {
    const RecordingProgress progress = recorder_.progress();
    if (options_.json) {
      out_.add(json_document(recording_json(file_, recorder_)));
    } else {
      out_.add(fmt::format("{}: {}{}\n", escaped(file_.string()), progress_text(recorder_),
                           progress.files > 1 ? fmt::format(", in {} files", progress.files) : ""));
    }
  }

  const RecordOptions& options_;
  std::filesystem::path file_;
  Recorder& recorder_;
  RecordingFolder& folder_;
  Output& out_;
  MonoTime end_;
  MonoTime started_ = MonoClock::now();
  bool has_named_unused_ = false;
};

// What a disk has damaged stays lost; it is found by reading all, and reported.
Result<void> repair(const RecordOptions& options, Output& out) {
  const RecordingRepair repaired = DSSM_TRY(repair_recording(options.repair));
  const Recording recording = DSSM_TRY(open_recording(options.repair, {}));
  std::uint64_t readable = 0;
  RecordingCursor cursor = recording.cursor();
  for (RecordedSample sample; cursor.next(sample);) ++readable;
  const std::vector<std::string> damages = recording.warnings();
  for (const std::string& damage : damages) {
    print_error(fmt::format("dssmctl: record: {}\n", escaped_message(damage)));
  }
  if (options.json) {
    out.add(json_document({{"file", options.repair},
                           {"was_whole", repaired.was_whole && damages.empty()},
                           {"removed_bytes", repaired.removed_bytes},
                           {"samples", readable}}));
  } else {
    const std::string_view whole =
        damages.empty() ? "the file was whole" : "the file has its end, but parts are damaged";
    out.add(fmt::format(
        "{}: {}, {}\n", escaped(options.repair), counted(readable, "sample", "samples"),
        repaired.was_whole ? whole
                           : fmt::format("completed, {} of an incomplete record removed",
                                         bytes_text(repaired.removed_bytes))));
  }
  if (damages.empty()) return {};
  const std::string file = escaped(options.repair);
  if (readable >= repaired.samples) {
    return Error{Errc::protocol,
                 fmt::format("'{}' has damaged parts (above); all its samples can be read", file)};
  }
  return Error{Errc::protocol,
               fmt::format("{} of the samples of '{}' cannot be read, and nothing brings them "
                           "back{}",
                           repaired.samples - readable, file,
                           readable == 0 ? ""
                                         : fmt::format("; `dssmctl convert {} OTHER.mcap` makes a "
                                                       "recording of the others",
                                                       file))};
}

}  // namespace

std::string progress_text(const Recorder& recorder) {
  const RecordingProgress progress = recorder.progress();
  return fmt::format("{} of {}, {}, {} lost", counted(progress.samples, "sample", "samples"),
                     counted(recorder.streams(), "stream", "streams"),
                     bytes_text(progress.file_bytes + progress.waiting_bytes),
                     progress.lost_samples);
}

Json recording_json(const std::filesystem::path& file, const Recorder& recorder) {
  const RecordingProgress progress = recorder.progress();
  return {{"file", file.string()},
          {"files", progress.files},
          {"streams", recorder.streams()},
          {"samples", progress.samples},
          {"payload_bytes", progress.payload_bytes},
          {"file_bytes", progress.file_bytes},
          {"lost_samples", progress.lost_samples}};
}

Result<void> run(const RecordOptions& options, Output& out) {
  if (!options.repair.empty()) return repair(options, out);
  DSSM_TRY(check_output(options));
  Session session = DSSM_TRY(connect(options, options.black_box ? kBlackBoxProgram : ""));
  RecordingOptions how;
  how.compression = compression_of(options.compression);
  // With the time that samples wait in their rings, at most a second is missing after a kill.
  how.chunk_age = std::chrono::milliseconds(800);
  RecorderPlan plan{StreamFilter(options.hosts, options.patterns),
                    options.types,
                    options.past,
                    {},
                    options.black_box};
  plan.keep_removed = std::max(plan.keep_removed, options.before);
  // The past is overwritten meanwhile.
  if (!options.past) add_types_of_programs(plan, session);
  if (options.black_box) return run_black_box(options, std::move(session), plan, how, out);

  const std::filesystem::path file = file_of(options);
  how.max_file_bytes = options.max_file_bytes;
  how.max_file_duration = options.max_file_duration;
  how.max_total_bytes = options.max_total_bytes;
  // The newest file is never deleted, so it must not take much of the quota.
  if (options.quota_bytes > 0 && how.max_file_bytes == 0) {
    how.max_file_bytes = std::max<std::uint64_t>(options.quota_bytes / 8, 1);
  }
  RecordingFolder folder(file.has_parent_path() ? file.parent_path() : ".", options.quota_bytes);
  if (options.quota_bytes > 0) DSSM_TRY(prepare(folder));
  RecordingWriter writer = DSSM_TRY(RecordingWriter::create(file, how));
  catch_stop_signals();
  const std::unique_ptr<Recorder> recorder =
      DSSM_TRY(Recorder::start(std::move(session), std::move(writer), plan));
  return RecordingRun(options, file, *recorder, folder, out).run();
}

Result<void> prepare(RecordingFolder& folder) {
  const Result<void> room = folder.make_room(0);
  for (const std::string& text : folder.take_notices()) {
    print_error(fmt::format("dssmctl: record: {}\n", text));
  }
  DSSM_TRY(room);
  const Result<std::filesystem::path> repaired = folder.repair_newest();
  if (!repaired || !repaired->empty()) {
    print_error(fmt::format("dssmctl: record: {}\n",
                            repaired ? fmt::format("'{}' was not finished, and is completed",
                                                   escaped(repaired->string()))
                                     : escaped_message(repaired.error().message)));
  }
  return {};
}

}  // namespace dssm::ctl
