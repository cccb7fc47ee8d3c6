// SPDX-License-Identifier: Apache-2.0
//
// dssmctl delay: how old samples are when they arrive here, that is the time on this PC's clock
// when this program was woken for a sample, minus the sample's stamp. For a stream of another host
// these are two clocks, and the figure is as good as both together.
#include "client/dssmctl/clocks.hpp"
#include "client/dssmctl/json.hpp"
#include "client/dssmctl/meter.hpp"
#include "client/dssmctl/statistics.hpp"
#include "client/dssmctl/text.hpp"
#include "client/dssmctl/verbs.hpp"

namespace dssm::ctl {
namespace {

void print_json(const MeterState& state, const Statistics& delays, const Clocks& clocks,
                Output& out) {
  const auto known = [&](auto value) { return delays.count > 0 ? Json(value) : Json(); };
  Json json = report_json(state, "samples", delays.count);
  json["delay_mean_ns"] = known(delays.mean_ns);
  json["delay_min_ns"] = known(to_ns(delays.min));
  json["delay_max_ns"] = known(to_ns(delays.max));
  json["delay_std_dev_ns"] = known(delays.std_dev_ns);
  json["delay_error_ns"] = bound_json(clocks.delay_error());
  out.add(json_line(json));
}

void print_text(const MeterState& state, const Statistics& delays, const Clocks& clocks,
                Output& out) {
  if (state.final) out.add(final_line(state));
  if (!state.final && state.new_samples == 0) return out.add("no new samples\n");
  if (delays.count == 0) return;
  out.add("average delay: " + fixed_text(delays.mean_ns / 1e9, 9) + " s\n\tmin: " +
          seconds_text(to_ns(delays.min)) + " s max: " + seconds_text(to_ns(delays.max)) +
          " s std dev: " + fixed_text(delays.std_dev_ns / 1e9, 9) +
          " s window: " + std::to_string(delays.count) + "\n");
  if (!clocks.are_two()) return;
  const Duration error = clocks.delay_error();
  out.add(error == kUnknownClockError ? "\tclocks: unknown, so this may be off by any amount\n"
                                      : "\tclocks: at most " + duration_text(error) + " apart\n");
}

}  // namespace

Result<void> run(const DelayOptions& options, Output& out) {
  Window delays(options.window);
  Clocks clocks(options.window);
  Meter meter;
  meter.on_sample = [&](const SampleInfo& info, Time arrival) {
    delays.add(saturating_sub(arrival, info.time));
    clocks.add(info);
  };
  meter.on_report = [&](const MeterState& state, Session& session) {
    // While dssmd is unavailable the last bounds stay; the reports do not wait for it.
    if (session.is_connected()) {
      if (const auto hosts = session.list_hosts()) clocks.update(*hosts, state.stream.host);
    }
    const auto print = options.json ? print_json : print_text;
    print(state, delays.statistics(), clocks, out);
  };
  return run_meter(options, out, meter);
}

}  // namespace dssm::ctl
