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

// The newest samples: the intervals between neighbouring ones, none across a gap or a pause, and
// how long they are.
class RateMeter : public Meter {
 public:
  explicit RateMeter(std::uint64_t window) : window_(window) {}

  void on_sample(const SampleInfo& info, Time) override {
    if (previous_) intervals_.add(saturating_sub(info.time, *previous_));
    previous_ = info.time;
    payload_bytes_.push_back(info.payload_bytes);
    if (payload_bytes_.size() > window_) payload_bytes_.pop_front();
  }
  void on_gap() override { previous_.reset(); }
  void on_pause() override {
    intervals_ = Window(window_ - 1);
    payload_bytes_.clear();
    previous_.reset();
  }

 protected:
  Statistics intervals() const { return intervals_.statistics(); }
  // In samples.
  std::size_t window() const { return payload_bytes_.empty() ? 0 : intervals_.size() + 1; }
  // 0 when unknown: too few samples, stamps that do not move on, or none come.
  double rate_hz(const MeterState& state) const {
    const Statistics found = intervals();
    const bool is_known = found.count > 0 && found.mean_ns > 0 && !is_silent(state);
    return is_known ? 1e9 / found.mean_ns : 0;
  }
  // 0 without samples.
  double mean_payload_bytes() const {
    const double sum = std::accumulate(payload_bytes_.begin(), payload_bytes_.end(), 0.0);
    return payload_bytes_.empty() ? 0 : sum / static_cast<double>(payload_bytes_.size());
  }

  // `unknown`: the text where the rate is unknown.
  std::string rate_text(const MeterState& state, const char* unknown) const {
    const double rate = rate_hz(state);
    return rate > 0 ? fmt::format("{:.3f} Hz", rate) : unknown;
  }
  static std::string too_few(const MeterState& state) {
    return state.final ? "" : "one sample only, no rate yet\n";
  }

  void add_common_json(const MeterState& state, Json& json) const {
    json["intervals"] = intervals_.size();
    json["payload_bytes"] = state.payload_bytes;
    json["rate_hz"] = rate_hz(state) > 0 ? Json(rate_hz(state)) : Json();
  }

 private:
  // The last report is about the whole time.
  static bool is_silent(const MeterState& state) { return state.stalled && !state.final; }

  std::uint64_t window_;
  Window intervals_{window_ - 1};
  std::optional<Time> previous_;
  std::deque<std::uint64_t> payload_bytes_;
};

class HzMeter : public RateMeter {
 public:
  using RateMeter::RateMeter;

  void add_json(const MeterState& state, Json& json) const override {
    add_common_json(state, json);
    add_statistics(json, "interval", intervals());
  }

  std::string text(const MeterState& state) const override {
    if (intervals().count == 0) return too_few(state);
    return fmt::format("average rate: {}\n{}", rate_text(state, "unknown"),
                       statistics_line(intervals(), window()));
  }

  std::vector<std::string> cells(const MeterState& state) const override {
    std::vector<std::string> cells = statistics_cells(intervals());
    cells.insert(cells.begin(), rate_text(state, "-"));
    cells.push_back(std::to_string(window()));
    return cells;
  }
};

class BwMeter : public RateMeter {
 public:
  using RateMeter::RateMeter;

  void add_json(const MeterState& state, Json& json) const override {
    add_common_json(state, json);
    json["mean_payload_bytes"] = state.seen > 0 ? Json(mean_payload_bytes()) : Json();
    const double rate = rate_hz(state);
    json["bytes_per_second"] = rate > 0 ? Json(rate * mean_payload_bytes()) : Json();
  }

  std::string text(const MeterState& state) const override {
    if (intervals().count == 0) return too_few(state);
    return fmt::format(
        "average: {}\n\tpayload: {} rate: {} window: {}\n", bandwidth_text(state, "unknown"),
        bytes_text(std::llround(mean_payload_bytes())), rate_text(state, "unknown"), window());
  }

  std::vector<std::string> cells(const MeterState& state) const override {
    return {bandwidth_text(state, "-"),
            window() > 0 ? bytes_text(std::llround(mean_payload_bytes())) : "-",
            rate_text(state, "-"), std::to_string(window())};
  }

 private:
  std::string bandwidth_text(const MeterState& state, const char* unknown) const {
    const double rate = rate_hz(state);
    return rate > 0 ? byte_rate_text(rate * mean_payload_bytes()) : unknown;
  }
};

}  // namespace

Result<void> run(const HzOptions& options, Output& out) {
  constexpr auto kRight = Table::Align::right;
  return run_meter(options, out,
                   {true,
                    {{"RATE", kRight},
                     {"MIN", kRight},
                     {"MAX", kRight},
                     {"STD DEV", kRight},
                     {"WINDOW", kRight}},
                    [&](const RawReader&) { return std::make_unique<HzMeter>(options.window); }});
}

Result<void> run(const BwOptions& options, Output& out) {
  constexpr auto kRight = Table::Align::right;
  return run_meter(
      options, out,
      {true,
       {{"BANDWIDTH", kRight}, {"PAYLOAD", kRight}, {"RATE", kRight}, {"WINDOW", kRight}},
       [&](const RawReader&) { return std::make_unique<BwMeter>(options.window); }});
}

}  // namespace dssm::ctl
