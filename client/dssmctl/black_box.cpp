// SPDX-License-Identifier: Apache-2.0
#include "client/dssmctl/black_box.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <random>
#include <utility>

#include "client/dssmctl/black_box_streams.hpp"
#include "client/dssmctl/text.hpp"
#include "client/dssmctl/trigger_watch.hpp"
#include "core/base/text.hpp"
#include "core/base/try.hpp"

namespace dssm::ctl {
namespace {

class BlackBox {
 public:
  BlackBox(const RecordOptions& options, Session session, const RecordingOptions& how,
           Recorder& recorder, TriggerWatch& watch, RecordingFolder& folder, Output& out)
      : options_(options),
        session_(std::move(session)),
        how_(how),
        recorder_(recorder),
        watch_(watch),
        folder_(folder),
        out_(out) {
    std::random_device random;
    how_.recording = hex(std::uint64_t{random()} << 32 | random());
  }

  // Until a stop signal; an incident that is being recorded ends then, too.
  void run() {
    do {
      for (const RecordedTrigger& trigger : watch_.take_fired()) on_trigger(trigger);
      if (const Result<void> taken = recorder_.take(); !taken) {
        end_incident(&taken.error());
      } else if (recorder_.is_recording()) {
        make_room();
        if (is_over()) end_incident(nullptr);
      }
      report_notices();
    } while (out_.sleep_until(recorder_.next_take()));
    if (recorder_.is_recording()) end_incident(nullptr);
    report_notices();
  }

 private:
  void on_trigger(const RecordedTrigger& trigger) {
    const std::string text =
        fmt::format("trigger '{}' of host '{}'{}", escaped(trigger.name), escaped(trigger.host),
                    trigger.reason.empty() ? "" : ": " + escaped_message(trigger.reason));
    if (recorder_.is_recording()) {
      const Result<void> added = recorder_.add_trigger(trigger);
      if (added) {
        notice(fmt::format("{}; '{}' continues", text, escaped(file_.string())));
        end_ = std::min(deadline_in(options_.after), last_end_);
        return;
      }
      end_incident(&added.error());  // and this is one of its own
    }
    const Result<void> begun = begin_incident(trigger);
    notice(begun ? fmt::format("{}; records '{}'", text, escaped(file_.string()))
                 : fmt::format("{}; it cannot be recorded: {}", text,
                               escaped_message(begun.error().message)));
  }

  Result<void> begin_incident(const RecordedTrigger& trigger) {
    DSSM_TRY(folder_.make_room(written_bytes_));
    RecordingWriter writer = DSSM_TRY(create_file(incident_name(WallClock::now(), trigger.name)));
    DSSM_TRY(writer.add_trigger(trigger));
    DSSM_TRY(recorder_.begin(std::move(writer), options_.before));
    trigger_ = trigger;
    end_ = deadline_in(options_.after);
    last_end_ = deadline_in(std::max(options_.max_incident, options_.after));
    return {};
  }

  // Two incidents of one trigger may begin in one second.
  Result<RecordingWriter> create_file(const std::filesystem::path& name) {
    for (int number = 0;; ++number) {
      file_ = folder_.path() / name;
      if (number > 0) {
        file_.replace_filename(fmt::format("{}_{}.mcap", name.stem().string(), number));
      }
      Result<RecordingWriter> writer = RecordingWriter::create(file_, how_);
      if (writer || writer.error().code != Errc::conflict) return writer;
    }
  }

  bool is_over() {
    const MonoTime now = MonoClock::now();
    const RecordingProgress progress = recorder_.progress();
    if (options_.quota_bytes > 0 &&
        progress.file_bytes + progress.waiting_bytes > options_.quota_bytes / 2) {
      notice(fmt::format("'{}' takes half of --quota, and ends", escaped(file_.string())));
      return true;
    }
    if (now < end_) return false;
    if (recorder_.has_past()) return true;
    if (!recorder_.is_past_late()) return false;
    notice("not all of the past has come; is another host slow or silent? See `dssmctl hosts`");
    return true;
  }

  // failed: what ended it; null: it is complete.
  void end_incident(const Error* failed) {
    const Result<void> ended = recorder_.end();
    make_room();
    written_bytes_ += recorder_.progress().file_bytes;
    how_.earlier_files += recorder_.progress().files;
    if (failed || !ended) {
      notice(escaped_message(failed ? failed->message : ended.error().message));
    }
    report_notices();
    if (options_.json) {
      out_.add(json_line(recording_json(file_, recorder_)));
    } else {
      out_.add(fmt::format("{}: {}\n", escaped(file_.string()), progress_text(recorder_)));
    }
    out_.flush();
    announce();
  }

  // Creates the stream only now: who never has an incident needs none.
  void announce() {
    const RecordingProgress progress = recorder_.progress();
    RecordedIncident incident{};
    set_text(incident.trigger, trigger_.name);
    set_text(incident.host, trigger_.host);
    set_text(incident.reason, trigger_.reason);
    set_text(incident.file, std::filesystem::absolute(file_).string());
    incident.samples = progress.samples;
    incident.lost_samples = progress.lost_samples;
    Result<Writer<RecordedIncident>> writer = session_.create<RecordedIncident>(
        kIncidentStream, History{64, std::chrono::seconds(1)}, {.keep_existing = true});
    if (writer) {
      writer->write(incident);
    } else {
      notice(fmt::format("the incident is not announced in '{}': {}", kIncidentStream,
                         escaped_message(writer.error().message)));
    }
  }

  void make_room() {
    const Result<void> made = folder_.make_room(written_bytes_ + recorder_.progress().file_bytes);
    if (!made) notice(escaped_message(made.error().message));
  }

  void report_notices() {
    for (const std::string& text : recorder_.take_notices()) notice(text);
    for (const std::string& text : watch_.take_notices()) notice(text);
    for (const std::string& text : folder_.take_notices()) notice(text);
  }

  static void notice(const std::string& text) {
    print_error(fmt::format("dssmctl: record: {}\n", text));
  }

  const RecordOptions& options_;
  Session session_;
  RecordingOptions how_;  // all incidents are one recording
  Recorder& recorder_;
  TriggerWatch& watch_;
  RecordingFolder& folder_;
  Output& out_;
  std::filesystem::path file_;       // of the incident that is being recorded, or of the last one
  RecordedTrigger trigger_;          // which began it
  MonoTime end_{}, last_end_{};      // of it
  std::uint64_t written_bytes_ = 0;  // by incidents that have ended
};

}  // namespace

Result<void> run_black_box(const RecordOptions& options, Session session, const RecorderPlan& plan,
                           const RecordingOptions& how, Output& out) {
  std::vector<TriggerRule> rules;
  for (const std::string& text : options.triggers) {
    rules.push_back(DSSM_TRY(TriggerRule::parse(text)));
  }
  RecordingFolder folder(options.file.empty() ? "." : options.file, options.quota_bytes);
  DSSM_TRY(prepare(folder));
  catch_stop_signals();
  const std::unique_ptr<Recorder> recorder = DSSM_TRY(Recorder::start(session, std::nullopt, plan));
  TriggerWatch watch(session, std::move(rules), options.min_interval);
  BlackBox(options, std::move(session), how, *recorder, watch, folder, out).run();
  return {};
}

}  // namespace dssm::ctl
