// SPDX-License-Identifier: Apache-2.0
//
// dssmctl delay: how old samples are when they arrive here, that is the time on this PC's clock
// when this program was woken for a sample, minus the sample's stamp. For a stream of another host
// these are two clocks, and the figure is as good as both together.
#include "client/dssmctl/delay.hpp"

#include <fmt/format.h>

#include <algorithm>

#include "client/dssmctl/meter.hpp"
#include "client/dssmctl/options.hpp"
#include "client/dssmctl/output.hpp"
#include "client/dssmctl/statistics.hpp"
#include "client/dssmctl/text.hpp"

namespace dssm::ctl {

void Clocks::add(const SampleInfo& info) {
  const bool known = info.clock_error < kForeignClockError;
  some_unknown_ |= !known;
  if (known) known_errors_.add(info.clock_error);
}

void Clocks::update(const std::vector<HostInfo>& hosts, std::string_view owner) {
  owner_bound_ = kUnknownClockError;  // nothing is known of the clock of a host that is not up
  for (const HostInfo& host : hosts) {
    if (host.state == HostState::self) {
      two_clocks_ = host.name != owner;
      own_bound_ = host.clock_bound();
    } else if (host.state == HostState::up && host.name == owner) {
      owner_bound_ = host.clock_bound();
    }
  }
}

Duration Clocks::delay_error() const {
  if (!two_clocks_) return Duration::zero();
  Duration stamps = known_errors_.statistics().max;
  if (some_unknown_) stamps = std::max(stamps, owner_bound_);
  return stamps > kUnknownClockError - own_bound_ ? kUnknownClockError : stamps + own_bound_;
}

namespace {

void print_json(const MeterState& state, const Statistics& delays, const Clocks& clocks,
                Output& out) {
  Json json = report_json(state, "samples", delays.count);
  add_statistics(json, "delay", delays);
  json["delay_error_ns"] = bound_json(clocks.delay_error());
  out.add(json_line(json));
}

void print_text(const MeterState& state, const Statistics& delays, const Clocks& clocks,
                Output& out) {
  if (state.final) out.add(final_line(state));
  if (!state.final && state.new_samples == 0) return out.add("no new samples\n");
  if (delays.count == 0) return;
  out.add(fmt::format("average delay: {:.9f} s\n{}", delays.mean_ns / 1e9,
                      statistics_line(delays, delays.count)));
  if (!clocks.are_two()) return;
  const Duration error = clocks.delay_error();
  out.add(error == kUnknownClockError
              ? "\tclocks: unknown, so this may be off by any amount\n"
              : fmt::format("\tclocks: at most {} apart\n", duration_text(error)));
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
