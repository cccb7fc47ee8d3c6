// SPDX-License-Identifier: Apache-2.0
//
// dssmctl hz: how often samples come, by their own stamps; dssmctl bw: how many bytes that makes.
#include <fmt/format.h>

#include <optional>

#include "client/dssmctl/meter.hpp"
#include "client/dssmctl/options.hpp"
#include "client/dssmctl/output.hpp"
#include "client/dssmctl/statistics.hpp"
#include "client/dssmctl/text.hpp"

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
  return rate > 0 ? fmt::format("{:.3f} Hz", rate) : "unknown";
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
    Json json = common_json(state, intervals);
    add_statistics(json, "interval", intervals);
    return out.add(json_line(json));
  }
  if (!measurable(state, intervals, out)) return;
  out.add(fmt::format("average rate: {}\n{}", precise_rate_text(rate_hz(intervals)),
                      statistics_line(intervals, intervals.count + 1)));
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
  out.add(fmt::format("average: {}\n\tpayload: {} rate: {} window: {}\n",
                      rate > 0 ? byte_rate_text(bytes_per_second) : "unknown",
                      bytes_text(state.payload_bytes), precise_rate_text(rate),
                      intervals.count + 1));
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
