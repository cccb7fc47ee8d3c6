// SPDX-License-Identifier: Apache-2.0
#include "client/dssmctl/meter.hpp"

#include <fmt/format.h>

#include <algorithm>

#include "client/dssmctl/open_stream.hpp"
#include "client/dssmctl/text.hpp"
#include "core/base/try.hpp"

namespace dssm::ctl {
namespace {

// Reads the stamps of all samples after the reader's cursor, up to the newest one of this moment.
class StampReader {
 public:
  StampReader(RawReader& reader, const Meter& meter, MeterState& state)
      : reader_(reader), meter_(meter), state_(state) {}

  void read_new() {
    read_ring();
    while (restarted()) {
      report_restart(reader_);
      state_.restarts = reader_.restarts();
      if (meter_.on_gap) meter_.on_gap();
      read_ring();
    }
    state_.age = saturating_sub(WallClock::now(), newest_time_);
  }

 private:
  void read_ring() {
    const Time arrival = WallClock::now();
    const Tid newest = reader_.newest_tid();
    Tid tid = reader_.cursor() + 1;
    while (tid <= newest) {
      SampleInfo info;
      const ReadStatus status = reader_.read_info(tid, info);
      if (status == ReadStatus::arriving) break;  // counted when it is here
      if (status != ReadStatus::ok) {
        const Tid next = std::max(reader_.oldest_tid(), tid + 1);
        state_.lost += static_cast<std::uint64_t>(next - tid);
        if (meter_.on_gap) meter_.on_gap();
        tid = next;
        continue;
      }
      ++tid;
      ++state_.seen;
      ++state_.new_samples;
      newest_time_ = info.time;
      meter_.on_sample(info, arrival);
    }
    reader_.seek(tid - 1);
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
  const Meter& meter_;
  MeterState& state_;
  Time newest_time_{};
};

// The last sample not to count: before the newest `window` ones, or before what is to come.
Tid start_before(const RawReader& reader, const Meter& meter, std::uint64_t window, bool awaited) {
  const Tid newest = reader.newest_tid();
  if (!meter.from_history) return awaited ? kNoTid : newest;
  const Tid start = std::max(newest - static_cast<Tid>(window), reader.oldest_tid() - 1);
  SampleInfo info;
  Tid tid = newest;
  while (tid > start && reader.read_info(tid, info) != ReadStatus::arriving) --tid;
  return tid;
}

}  // namespace

Result<void> run_meter(const MeterOptions& options, Output& out, const Meter& meter) {
  const FetchHistory history = meter.from_history ? FetchHistory::at_once : FetchHistory::when_read;
  return with_stream(options, history, [&](OpenedStream& opened) -> Result<void> {
    RawReader& reader = opened.reader;
    Follower follower = DSSM_TRY(Follower::open(opened.session, reader, out));

    MeterState state;
    state.stream = reader.id();
    state.payload_bytes = reader.payload_bytes();
    StampReader stamps(reader, meter, state);
    reader.seek(std::max(kNoTid, start_before(reader, meter, options.window, opened.awaited)));
    if (meter.from_history) stamps.read_new();

    std::uint64_t reports = 0;
    MonoTime due = deadline_in(options.interval);
    while (true) {
      const bool early = meter.from_history && reports == 0 && state.seen >= 2;
      if (early || MonoClock::now() >= due) {
        meter.on_report(state, opened.session);
        state.new_samples = 0;
        if (!out.flush() || ++reports == options.count) return {};
        due = deadline_in(options.interval);
      }
      const Follower::Wake wake = follower.wait(due);
      stamps.read_new();
      if (wake == Follower::Wake::stop || wake == Follower::Wake::ended) {
        state.final = true;
        meter.on_report(state, opened.session);
        if (wake == Follower::Wake::ended) return end_of(reader);
        return {};
      }
    }
  });
}

Json report_json(const MeterState& state, const char* measured_key, std::uint64_t measured) {
  Json json;
  json["stream"] = state.stream.str();
  json[measured_key] = measured;
  json["new_samples"] = state.new_samples;
  json["seen_samples"] = state.seen;
  json["lost_samples"] = state.lost;
  json["restarts"] = state.restarts;
  json["final"] = state.final;
  return json;
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
  return fmt::format("\tmin: {} s max: {} s std dev: {:.9f} s window: {}\n",
                     seconds_text(to_ns(statistics.min)), seconds_text(to_ns(statistics.max)),
                     statistics.std_dev_ns / 1e9, window);
}

std::string final_line(const MeterState& state) {
  return fmt::format("--- {}: {} samples, {} lost{} ---\n", escaped(state.stream.str()), state.seen,
                     state.lost,
                     state.restarts > 0 ? fmt::format(", restarts: {}", state.restarts) : "");
}

}  // namespace dssm::ctl
