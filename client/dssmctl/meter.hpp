// SPDX-License-Identifier: Apache-2.0
//
// What hz, bw and delay have in common: following a stream's stamps, without ever touching a
// payload, and reporting at intervals.
#pragma once

#include <cstdint>
#include <dssm/session.hpp>
#include <functional>
#include <string>

#include "client/dssmctl/options.hpp"
#include "client/dssmctl/output.hpp"
#include "client/dssmctl/statistics.hpp"

namespace dssm::ctl {

// What a report may show beside the measurements.
struct MeterState {
  StreamId stream;
  std::uint64_t payload_bytes = 0;  // of the stream: of its longest samples
  std::uint64_t seen = 0;           // samples since the start
  std::uint64_t new_samples = 0;    // since the last report
  std::uint64_t lost = 0;           // overwritten before their stamps were read, since the start
  std::uint64_t restarts = 0;       // of the stream, since the start
  Duration age{};                   // of the newest sample seen; meaningless while seen is 0
  bool final = false;               // the last one, not after an interval
};

struct Meter {
  // Whether to begin with the samples that the ring holds already; then the first report comes as
  // soon as there are two samples, not after an interval.
  bool from_history = false;
  std::function<void(const SampleInfo& info, Time arrival)> on_sample;
  std::function<void()> on_gap;  // the next sample does not follow the last one
  std::function<void(const MeterState& state, Session& session)> on_report;
};

// Runs until `options.count` reports are made; or until Ctrl-C or the end of the stream, with one
// more report.
Result<void> run_meter(const MeterOptions& options, Output& out, const Meter& meter);

// The keys with which every report as JSON begins. `measured` is the number of what was measured,
// called `measured_key`: the samples of delays, the intervals of rates.
Json report_json(const MeterState& state, const char* measured_key, std::uint64_t measured);

// Adds NAME_mean_ns, NAME_min_ns, NAME_max_ns and NAME_std_dev_ns; null while nothing was measured.
void add_statistics(Json& json, const std::string& name, const Statistics& statistics);

// "\tmin: 0.001 s max: ... window: 12\n", for people.
std::string statistics_line(const Statistics& statistics, std::size_t window);

// "--- odom:0@pc1: 12 samples, 0 lost ---", before a final report for people.
std::string final_line(const MeterState& state);

}  // namespace dssm::ctl
