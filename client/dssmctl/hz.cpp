// SPDX-License-Identifier: Apache-2.0
//
// dssmctl hz: how often samples come, by their own stamps; dssmctl bw: how many bytes that makes.
#include <optional>

#include "client/dssmctl/json.hpp"
#include "client/dssmctl/meter.hpp"
#include "client/dssmctl/statistics.hpp"
#include "client/dssmctl/text.hpp"
#include "client/dssmctl/verbs.hpp"

namespace dssm::ctl {
namespace {

// The intervals between neighbouring samples; none across a gap.
class Intervals {
 public:
  explicit Intervals(std::uint64_t window) : window_(window - 1) {}

  void on_sample(const SampleInfo& info) {
    if (previous_) window_.add(saturating_sub(info.time, *previous_));
    previous_ = info.time;
  }
  void on_gap() { previous_.reset(); }

  Statistics statistics() const { return window_.statistics(); }

 private:
  Window window_;
  std::optional<Time> previous_;
};

// 0 when unknown: too few samples, or stamps that do not move on.
double rate_hz(const Statistics& intervals) {
  return intervals.count > 0 && intervals.mean_ns > 0 ? 1e9 / intervals.mean_ns : 0;
}

std::string precise_rate_text(double rate) {
  return rate > 0 ? fixed_text(rate, 3) + " Hz" : "unknown";
}

// Whether there is something to measure; prints the reason when there is not.
bool measurable(const MeterState& state, const Statistics& intervals, Output& out) {
  if (state.final) out.add(final_line(state));
  if (!state.final && state.new_samples == 0) {
    out.add(state.seen == 0 ? "no samples yet\n" : "no new samples\n");
    return false;
  }
  if (intervals.count > 0) return true;
  if (!state.final) out.add("one sample only, no rate yet\n");
  return false;
}

Json common_json(const MeterState& state, const Statistics& intervals) {
  Json json = report_json(state, "intervals", intervals.count);
  json["payload_bytes"] = state.payload_bytes;
  json["age_ns"] = state.seen > 0 ? Json(to_ns(state.age)) : Json();
  json["rate_hz"] = rate_hz(intervals) > 0 ? Json(rate_hz(intervals)) : Json();
  return json;
}

void print_hz(const MeterState& state, const Statistics& intervals, bool as_json, Output& out) {
  if (as_json) {
    const auto known = [&](auto value) { return intervals.count > 0 ? Json(value) : Json(); };
    Json json = common_json(state, intervals);
    json["interval_mean_ns"] = known(intervals.mean_ns);
    json["interval_min_ns"] = known(to_ns(intervals.min));
    json["interval_max_ns"] = known(to_ns(intervals.max));
    json["interval_std_dev_ns"] = known(intervals.std_dev_ns);
    return out.add(json_line(json));
  }
  if (!measurable(state, intervals, out)) return;
  out.add("average rate: " + precise_rate_text(rate_hz(intervals)) + "\n\tmin: " +
          seconds_text(to_ns(intervals.min)) + " s max: " + seconds_text(to_ns(intervals.max)) +
          " s std dev: " + fixed_text(intervals.std_dev_ns / 1e9, 9) +
          " s window: " + std::to_string(intervals.count + 1) + "\n");
}

void print_bw(const MeterState& state, const Statistics& intervals, bool as_json, Output& out) {
  const double rate = rate_hz(intervals);
  const double bytes_per_second = rate * static_cast<double>(state.payload_bytes);
  if (as_json) {
    Json json = common_json(state, intervals);
    json["bytes_per_second"] = rate > 0 ? Json(bytes_per_second) : Json();
    return out.add(json_line(json));
  }
  if (!measurable(state, intervals, out)) return;
  out.add("average: " + (rate > 0 ? byte_rate_text(bytes_per_second) : "unknown") +
          "\n\tpayload: " + bytes_text(state.payload_bytes) + " rate: " + precise_rate_text(rate) +
          " window: " + std::to_string(intervals.count + 1) + "\n");
}

template <class Print>
Result<void> run_interval_meter(const MeterOptions& options, Output& out, Print print) {
  Intervals intervals(options.window);
  Meter meter;
  meter.from_history = true;
  meter.on_sample = [&](const SampleInfo& info, Time) { intervals.on_sample(info); };
  meter.on_gap = [&] { intervals.on_gap(); };
  meter.on_report = [&](const MeterState& state, Session&) {
    print(state, intervals.statistics(), options.json, out);
  };
  return run_meter(options, out, meter);
}

}  // namespace

Result<void> run(const HzOptions& options, Output& out) {
  return run_interval_meter(options, out, print_hz);
}

Result<void> run(const BwOptions& options, Output& out) {
  return run_interval_meter(options, out, print_bw);
}

}  // namespace dssm::ctl
