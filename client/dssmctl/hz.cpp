// SPDX-License-Identifier: Apache-2.0
//
// dssmctl hz: how often samples come, by their own stamps; dssmctl bw: how many bytes that makes.
#include <fmt/format.h>

#include <cmath>
#include <deque>
#include <numeric>
#include <optional>

#include "client/dssmctl/meter.hpp"
#include "client/dssmctl/options.hpp"
#include "client/dssmctl/output.hpp"
#include "client/dssmctl/statistics.hpp"
#include "client/dssmctl/text.hpp"

namespace dssm::ctl {
namespace {

// The newest samples: the intervals between neighbouring ones, none across a gap, and how long they
// are.
class NewestSamples {
 public:
  explicit NewestSamples(std::uint64_t window) : intervals_(window - 1), window_(window) {}

  void on_sample(const SampleInfo& info) {
    if (previous_) intervals_.add(saturating_sub(info.time, *previous_));
    previous_ = info.time;
    payload_bytes_.push_back(info.payload_bytes);
    if (payload_bytes_.size() > window_) payload_bytes_.pop_front();
  }
  void on_gap() { previous_.reset(); }

  Statistics intervals() const { return intervals_.statistics(); }
  // 0 without samples.
  double mean_payload_bytes() const {
    const double sum = std::accumulate(payload_bytes_.begin(), payload_bytes_.end(), 0.0);
    return payload_bytes_.empty() ? 0 : sum / static_cast<double>(payload_bytes_.size());
  }

 private:
  Window intervals_;
  std::optional<Time> previous_;
  std::uint64_t window_;
  std::deque<std::uint64_t> payload_bytes_;
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

void print_hz(const MeterState& state, const NewestSamples& samples, bool as_json, Output& out) {
  const Statistics intervals = samples.intervals();
  if (as_json) {
    Json json = common_json(state, intervals);
    add_statistics(json, "interval", intervals);
    return out.add(json_line(json));
  }
  if (!measurable(state, intervals, out)) return;
  out.add(fmt::format("average rate: {}\n{}", precise_rate_text(rate_hz(intervals)),
                      statistics_line(intervals, intervals.count + 1)));
}

void print_bw(const MeterState& state, const NewestSamples& samples, bool as_json, Output& out) {
  const Statistics intervals = samples.intervals();
  const double rate = rate_hz(intervals);
  const double bytes_per_second = rate * samples.mean_payload_bytes();
  if (as_json) {
    Json json = common_json(state, intervals);
    json["mean_payload_bytes"] = state.seen > 0 ? Json(samples.mean_payload_bytes()) : Json();
    json["bytes_per_second"] = rate > 0 ? Json(bytes_per_second) : Json();
    return out.add(json_line(json));
  }
  if (!measurable(state, intervals, out)) return;
  out.add(fmt::format("average: {}\n\tpayload: {} rate: {} window: {}\n",
                      rate > 0 ? byte_rate_text(bytes_per_second) : "unknown",
                      bytes_text(std::llround(samples.mean_payload_bytes())),
                      precise_rate_text(rate), intervals.count + 1));
}

template <class Print>
Result<void> run_interval_meter(const MeterOptions& options, Output& out, Print print) {
  NewestSamples samples(options.window);
  Meter meter;
  meter.from_history = true;
  meter.on_sample = [&](const SampleInfo& info, Time) { samples.on_sample(info); };
  meter.on_gap = [&] { samples.on_gap(); };
  meter.on_report = [&](const MeterState& state, Session&) {
    print(state, samples, options.json, out);
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
