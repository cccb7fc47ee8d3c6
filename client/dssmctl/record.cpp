// SPDX-License-Identifier: Apache-2.0
//
// dssmctl record: streams into an MCAP file, until Ctrl-C or a given time.
#include <fmt/format.h>

#include <algorithm>
#include <ctime>
#include <filesystem>

#include "client/dssmctl/open_stream.hpp"
#include "client/dssmctl/options.hpp"
#include "client/dssmctl/output.hpp"
#include "client/dssmctl/recorder.hpp"
#include "client/dssmctl/recording_info.hpp"
#include "client/dssmctl/text.hpp"
#include "core/base/try.hpp"

namespace dssm::ctl {
namespace {

// By then the streams that there are could have been opened.
constexpr Duration kFirstNoticeTime = std::chrono::seconds(1);
// Another host that sends nothing more is not waited for longer than that.
constexpr Duration kMaxPastWait = std::chrono::seconds(10);

// As ROS 2 names its recordings: "dssm_2026_11_27-12_30_00.mcap".
std::string file_name_of_now() {
  const std::time_t now = std::time(nullptr);
  std::tm local{};
  ::localtime_r(&now, &local);
  char text[64];
  const std::size_t length =
      std::strftime(text, sizeof text, "dssm_%Y_%m_%d-%H_%M_%S.mcap", &local);
  return {text, length};
}

std::filesystem::path file_of(const RecordOptions& options) {
  if (options.file.empty()) return file_name_of_now();
  std::error_code ignored;
  if (std::filesystem::is_directory(options.file, ignored)) {
    return std::filesystem::path(options.file) / file_name_of_now();
  }
  return options.file;
}

std::string progress_text(const Recorder& recorder) {
  const RecordingProgress progress = recorder.progress();
  return fmt::format("{} of {}, {}, {} lost", counted(progress.samples, "sample", "samples"),
                     counted(recorder.streams(), "stream", "streams"),
                     bytes_text(progress.file_bytes + progress.waiting_bytes),
                     progress.lost_samples);
}

// Records until it is to end, and says how it goes: on a terminal in a line that is redrawn.
class RecordingRun {
 public:
  RecordingRun(const RecordOptions& options, std::filesystem::path file, Recorder& recorder,
               Output& out)
      : options_(options),
        file_(std::move(file)),
        recorder_(recorder),
        out_(out),
        end_(options.duration ? deadline_in(*options.duration) : kNever) {}

  // Until Ctrl-C, in time, or because it cannot go on. The file is complete in any case.
  Result<void> run() {
    Result<void> recorded;
    do {
      recorded = recorder_.take();
      report();
    } while (recorded && !is_over() && out_.sleep_until(std::min(recorder_.next_take(), end_)));
    const Result<void> finished = recorder_.finish();
    report_notices();
    out_.clear_line();
    print_summary();
    return recorded ? finished : recorded;
  }

 private:
  bool is_over() {
    const MonoTime now = MonoClock::now();
    if (now >= end_ || (options_.until && WallClock::now() >= options_.until->time)) return true;
    if (!options_.past || options_.duration || options_.until || options_.follow) return false;
    if (recorder_.has_past()) return true;
    const std::uint64_t progress = recorder_.past_progress();
    if (std::exchange(past_progress_, progress) != progress) past_moved_ = now;
    if (now - past_moved_ < kMaxPastWait) return false;
    notice("not all of the past has come; is another host slow or silent? See `dssmctl hosts`");
    return true;
  }

  void report() {
    report_notices();
    if (recorder_.streams() == 0 && !has_waited_ &&
        MonoClock::now() - started_ > kFirstNoticeTime) {
      has_waited_ = true;
      notice("no stream fits; what comes is recorded");
    }
    if (options_.json) return;
    out_.redraw_line(
        [&] { return fmt::format("{}: {}", escaped(file_.string()), progress_text(recorder_)); });
  }

  void report_notices() {
    for (const std::string& text : recorder_.take_notices()) notice(text);
  }

  void notice(const std::string& text) {
    out_.clear_line();
    print_error(fmt::format("dssmctl: record: {}\n", text));
  }

  void print_summary() {
    const RecordingProgress progress = recorder_.progress();
    if (options_.json) {
      out_.add(json_document({{"file", file_.string()},
                              {"files", progress.files},
                              {"streams", recorder_.streams()},
                              {"samples", progress.samples},
                              {"payload_bytes", progress.payload_bytes},
                              {"file_bytes", progress.file_bytes},
                              {"lost_samples", progress.lost_samples}}));
    } else {
      out_.add(fmt::format("{}: {}{}\n", escaped(file_.string()), progress_text(recorder_),
                           progress.files > 1 ? fmt::format(", in {} files", progress.files) : ""));
    }
  }

  const RecordOptions& options_;
  std::filesystem::path file_;
  Recorder& recorder_;
  Output& out_;
  MonoTime end_;
  MonoTime started_ = MonoClock::now(), past_moved_ = started_;
  std::uint64_t past_progress_ = 0;
  bool has_waited_ = false;
};

Result<void> repair(const RecordOptions& options, Output& out) {
  const RecordingRepair repaired = DSSM_TRY(repair_recording(options.repair));
  if (options.json) {
    out.add(json_document({{"file", options.repair},
                           {"was_whole", repaired.was_whole},
                           {"removed_bytes", repaired.removed_bytes},
                           {"samples", repaired.samples}}));
    return {};
  }
  out.add(fmt::format(
      "{}: {}, {}\n", escaped(options.repair), counted(repaired.samples, "sample", "samples"),
      repaired.was_whole ? "the file was whole"
                         : fmt::format("completed, {} of an incomplete record removed",
                                       bytes_text(repaired.removed_bytes))));
  return {};
}

}  // namespace

Result<void> run(const RecordOptions& options, Output& out) {
  if (!options.repair.empty()) return repair(options, out);
  Session session = DSSM_TRY(connect(options));
  const std::filesystem::path file = file_of(options);
  RecordingOptions how;
  how.compression = compression_of(options.compression);
  how.max_file_bytes = options.max_file_bytes;
  how.max_file_duration = options.max_file_duration;
  how.max_total_bytes = options.max_total_bytes;
  RecordingWriter writer = DSSM_TRY(RecordingWriter::create(file, how));
  catch_stop_signals();
  const std::unique_ptr<Recorder> recorder = DSSM_TRY(Recorder::start(
      std::move(session), std::move(writer),
      {StreamFilter(options.hosts, options.patterns), options.types, options.past}));
  return RecordingRun(options, file, *recorder, out).run();
}

}  // namespace dssm::ctl
