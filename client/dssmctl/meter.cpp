// SPDX-License-Identifier: Apache-2.0
#include "client/dssmctl/meter.hpp"

#include <fmt/format.h>

#include <algorithm>

#include "client/dssmctl/describe.hpp"
#include "client/dssmctl/open_stream.hpp"
#include "client/dssmctl/text.hpp"
#include "core/base/try.hpp"

namespace dssm::ctl {
namespace {

// So often a stream is checked whose next sample is still to come although newer ones are here.
constexpr Duration kArrivingPeriod = std::chrono::milliseconds(10);

// Reads the stamps of all samples after the reader's cursor, up to the newest one of this moment.
class StampReader {
 public:
  //   in_order  waits for samples that come after newer ones
  StampReader(RawReader& reader, Meter& meter, MeterState& state, bool in_order)
      : reader_(reader),
        meter_(meter),
        state_(state),
        in_order_(in_order),
        pauses_(reader.cycle()) {}

  void read_new() {
    read_ring();
    while (restarted()) {
      report_restart(reader_);
      state_.restarts = reader_.restarts();
      on_gap();
      read_ring();
    }
  }

  // Before a report.
  void update_state() {
    state_.empty = reader_.newest_tid() == kNoTid;
    state_.arriving = reader_.newest_tid() > reader_.cursor();
    state_.age = saturating_sub(WallClock::now(), newest_time_);
    const Duration quiet = MonoClock::now() - newest_arrival_;
    const bool is_stalled = state_.seen > 0 && !state_.arriving && quiet >= pauses_.length();
    state_.stalled = is_stalled ? std::optional(quiet) : std::nullopt;
  }

  // The newest of the samples that were read came `age` ago.
  void set_arrival(Duration age) { newest_arrival_ = MonoClock::now() - age; }

 private:
  void on_gap() {
    pauses_.on_gap();
    meter_.on_gap();
  }

  void read_ring() {
    const Time arrival = WallClock::now();
    const Tid newest = reader_.newest_tid();
    Tid tid = reader_.cursor() + 1;
    while (tid <= newest) {
      SampleInfo info;
      const ReadStatus status = reader_.read_info(tid, info);
      if (status == ReadStatus::arriving && in_order_) break;  // counted when it is here
      if (status == ReadStatus::arriving) {
        ++state_.late;
        ++tid;
        on_gap();
        continue;
      }
      if (status != ReadStatus::ok) {
        const Tid next = std::max(reader_.oldest_tid(), tid + 1);
        state_.lost += static_cast<std::uint64_t>(next - tid);
        on_gap();
        tid = next;
        continue;
      }
      ++tid;
      on_sample(info, arrival);
    }
    reader_.seek(tid - 1);
  }

  void on_sample(const SampleInfo& info, Time arrival) {
    ++state_.seen;
    ++state_.new_samples;
    newest_time_ = info.time;
    newest_arrival_ = MonoClock::now();
    if (const std::optional<Duration> pause = pauses_.on_sample(info.time)) {
      state_.paused = pause;
      meter_.on_pause();
    }
    meter_.on_sample(info, arrival);
  }

  // Continues with the stream's new ring, when there is one; reading stamps alone would not report
  // it. No payload is read.
  bool restarted() {
    const Tid cursor = reader_.cursor();
    BorrowedSample next;
    if (reader_.borrow(cursor + 1, next) == ReadStatus::restarted) return true;
    reader_.seek(cursor);
    return false;
  }

  RawReader& reader_;
  Meter& meter_;
  MeterState& state_;
  bool in_order_;
  PauseDetector pauses_;
  Time newest_time_{};
  MonoTime newest_arrival_{};
};

// The last sample not to count: before the newest `window` ones, or before what is to come.
Tid start_before(const RawReader& reader, bool from_history, std::uint64_t window, bool awaited) {
  const Tid newest = reader.newest_tid();
  if (!from_history) return awaited ? kNoTid : newest;
  const Tid start = std::max(newest - static_cast<Tid>(window), reader.oldest_tid() - 1);
  SampleInfo info;
  Tid tid = newest;
  while (tid > start && reader.read_info(tid, info) != ReadStatus::arriving) --tid;
  return tid;
}

// A stream that is being measured. It stays where it is: its parts refer to each other.
struct Measured {
  Measured(OpenedStream stream, const MeterKind& kind)
      : opened(std::move(stream)),
        meter(kind.make(opened.reader)),
        stamps(opened.reader, *meter, state, kind.from_history) {
    state.stream = opened.reader.id();
    state.payload_bytes = opened.reader.payload_bytes();
  }
  Measured(const Measured&) = delete;
  Measured& operator=(const Measured&) = delete;

  Result<void> begin(const MeterOptions& options, const MeterKind& kind, Output& out) {
    RawReader& reader = opened.reader;
    follower.emplace(DSSM_TRY(Follower::open(opened.session, reader, out)));
    reader.seek(
        std::max(kNoTid, start_before(reader, kind.from_history, options.window, opened.awaited)));
    if (!kind.from_history) return {};
    const Result<StreamInfo> info = opened.session.stream_info(reader.id());
    stamps.read_new();
    if (info && info->newest == reader.cursor() && is_age_known(*info)) {
      stamps.set_arrival(info->age);
    }
    return {};
  }

  OpenedStream opened;
  std::unique_ptr<Meter> meter;
  MeterState state;
  StampReader stamps;
  std::optional<Follower> follower;
  bool ended = false;
};

// "paused for 163 s, window restarted"; empty: nothing.
std::string note(const MeterState& state) {
  std::string text;
  const auto add = [&](const std::string& part) { text += (text.empty() ? "" : "; ") + part; };
  if (state.paused) add("paused for " + duration_text(*state.paused) + ", window restarted");
  if (state.final) return text;
  if (state.stalled) {
    add("no new samples for " + duration_text(*state.stalled));
  } else if (state.new_samples == 0) {
    add(state.empty      ? "no samples yet"
        : state.arriving ? "the next samples are on their way, newer ones are here"
                         : "no new samples");
  }
  return text;
}

// "--- odom:0@pc1: 12 samples, 0 lost, 3 late ---", before a final report.
std::string final_line(const MeterState& state) {
  return fmt::format("--- {}: {} samples, {} lost{}{} ---\n", escaped(state.stream.str()),
                     state.seen, state.lost,
                     state.late > 0 ? fmt::format(", {} late", state.late) : "",
                     state.restarts > 0 ? fmt::format(", restarts: {}", state.restarts) : "");
}

class Meters {
 public:
  Meters(const MeterOptions& options, Output& out, const MeterKind& kind)
      : options_(options), out_(out), kind_(kind) {}

  Result<void> run() {
    std::vector<OpenedStream> opened =
        DSSM_TRY(open_streams(options_, options_.streams, history()));
    if (opened.empty()) return {};
    for (OpenedStream& stream : opened) {
      all_.push_back(std::make_unique<Measured>(std::move(stream), kind_));
      DSSM_TRY(all_.back()->begin(options_, kind_, out_));
    }
    std::uint64_t reports = 0;
    MonoTime due = deadline_in(options_.interval);
    while (true) {
      if ((reports == 0 && is_early()) || MonoClock::now() >= due) {
        report(false);
        if (!out_.flush() || ++reports == options_.count) return {};
        due = deadline_in(options_.interval);
      }
      if (!wait(due)) {
        report(true);
        return failure_;
      }
    }
  }

 private:
  FetchHistory history() const {
    return kind_.from_history ? FetchHistory::at_once : FetchHistory::when_read;
  }

  bool is_early() const {
    return kind_.from_history && std::any_of(all_.begin(), all_.end(),
                                             [](const auto& one) { return one->state.seen >= 2; });
  }

  // Waits until there is a sample, until `due`, or for a stop signal, and reads what is there.
  // Returns whether to continue.
  bool wait(MonoTime due) {
    std::vector<RawReader*> idle;
    MonoTime until = std::min(due, deadline_in(kStopCheckPeriod));
    std::size_t alive = 0;
    bool any = false;
    for (const auto& one : all_) alive += one->ended ? 0 : 1;
    for (const auto& one : all_) {
      if (one->ended) continue;
      const Follower::Wake wake = one->follower->wait(alive == 1 ? due : MonoTime());
      one->stamps.read_new();
      if (wake == Follower::Wake::stop) return false;
      if (wake == Follower::Wake::ended) on_end(*one);
      any |= wake != Follower::Wake::deadline;
      const bool arriving = one->opened.reader.newest_tid() > one->opened.reader.cursor();
      if (arriving) until = std::min(until, deadline_in(kArrivingPeriod));
      if (!arriving) idle.push_back(&one->opened.reader);
    }
    if (std::all_of(all_.begin(), all_.end(), [](const auto& one) { return one->ended; })) {
      return false;
    }
    if (any || alive == 1) return true;
    if (idle.empty()) return out_.sleep_until(until);
    static_cast<void>(wait_any(idle, until));
    return true;
  }

  void on_end(Measured& one) {
    one.ended = true;
    Error error = end_of(one.opened.reader);
    if (failure_) {
      failure_ = std::move(error);
    } else {
      failure_ = Error{failure_.error().code, failure_.error().message + "; and " + error.message};
    }
  }

  void report(bool final) {
    for (const auto& one : all_) {
      one->state.final = final;
      one->stamps.update_state();
    }
    if (options_.json) {
      for (const auto& one : all_) print_json(*one);
    } else if (all_.size() == 1) {
      print_block(*all_.front());
    } else {
      print_table(final);
    }
    for (const auto& one : all_) {
      one->state.new_samples = 0;
      one->state.paused.reset();
    }
  }

  void print_json(const Measured& one) {
    const MeterState& state = one.state;
    Json json;
    json["stream"] = state.stream.str();
    json["new_samples"] = state.new_samples;
    json["seen_samples"] = state.seen;
    json["lost_samples"] = state.lost;
    json["late_samples"] = state.late;
    json["restarts"] = state.restarts;
    json["age_ns"] = state.seen > 0 ? Json(to_ns(state.age)) : Json();
    json["paused_ns"] = state.paused ? Json(to_ns(*state.paused)) : Json();
    json["stalled_ns"] = state.stalled ? Json(to_ns(*state.stalled)) : Json();
    json["final"] = state.final;
    one.meter->add_json(state, json);
    out_.add(json_line(json));
  }

  void print_block(const Measured& one) {
    const MeterState& state = one.state;
    if (state.final) out_.add(final_line(state));
    if (const std::string line = note(state); !line.empty()) out_.add(line + "\n");
    if (state.final || (state.new_samples > 0 && !state.stalled)) {
      out_.add(one.meter->text(state));
    }
  }

  void print_table(bool final) {
    std::vector<Table::Column> columns = kind_.columns;
    columns.insert(columns.begin(), {"STREAM"});
    columns.push_back({"NOTE"});
    Table table(std::move(columns));
    for (const auto& one : all_) {
      std::vector<std::string> row = one->meter->cells(one->state);
      row.insert(row.begin(), escaped(one->state.stream.str()));
      row.push_back(one->ended ? "it was removed" : note(one->state));
      table.add_row(std::move(row));
    }
    if (final) {
      for (const auto& one : all_) out_.add(final_line(one->state));
    }
    table.print(out_);
    if (!final) out_.add("\n");
  }

  const MeterOptions& options_;
  Output& out_;
  const MeterKind& kind_;
  std::vector<std::unique_ptr<Measured>> all_;
  Result<void> failure_;  // of the streams that have ended
};

}  // namespace

std::optional<Duration> PauseDetector::on_sample(Time time) {
  constexpr std::size_t kIntervals = kRecentSamples - 1;
  std::optional<Duration> pause;
  if (previous_) {
    const Duration interval = saturating_sub(time, *previous_);
    // Before two intervals only the cycle is known, which may be far from the real one.
    if (recent_.size() >= 2 && interval >= length()) pause = interval;
    recent_.push_back(interval);
    if (recent_.size() > kIntervals) recent_.pop_front();
  }
  previous_ = time;
  return pause;
}

Duration PauseDetector::length() const {
  return pause_length(std::vector<Duration>(recent_.begin(), recent_.end()), cycle_);
}

Result<void> run_meter(const MeterOptions& options, Output& out, const MeterKind& kind) {
  return Meters(options, out, kind).run();
}

void add_statistics(Json& json, const std::string& name, const Statistics& statistics) {
  const auto add = [&](const char* what, auto value) {
    json[name + what] = statistics.count > 0 ? Json(value) : Json();
  };
  add("_mean_ns", statistics.mean_ns);
  add("_min_ns", to_ns(statistics.min));
  add("_max_ns", to_ns(statistics.max));
  add("_std_dev_ns", statistics.std_dev_ns);
}

std::string statistics_line(const Statistics& statistics, std::size_t window) {
  return fmt::format("\tmin: {} max: {} std dev: {} window: {}\n", duration_text(statistics.min),
                     duration_text(statistics.max), ns_text(statistics.std_dev_ns), window);
}

std::vector<std::string> statistics_cells(const Statistics& statistics) {
  if (statistics.count == 0) return {"-", "-", "-"};
  return {duration_text(statistics.min), duration_text(statistics.max),
          ns_text(statistics.std_dev_ns)};
}

}  // namespace dssm::ctl
