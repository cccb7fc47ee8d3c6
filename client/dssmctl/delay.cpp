// SPDX-License-Identifier: Apache-2.0
//
// dssmctl delay: how old samples are when they arrive here, that is the time on this PC's clock
// when this program was woken for a sample, minus the sample's stamp. For a stream of another host
// these are two clocks, and the figure is as good as both together.
#include <fmt/format.h>

#include <algorithm>

#include "client/dssmctl/meter.hpp"
#include "client/dssmctl/options.hpp"
#include "client/dssmctl/output.hpp"
#include "client/dssmctl/statistics.hpp"
#include "client/dssmctl/text.hpp"

namespace dssm::ctl {
namespace {

class DelayMeter : public Meter {
 public:
  DelayMeter(const RawReader& reader, std::uint64_t window)
      : reader_(reader), delays_(window), errors_(window) {}

  void on_sample(const SampleInfo& info, Time arrival) override {
    delays_.add(saturating_sub(arrival, info.time));
    errors_.add(reader_.clock_error(info));
  }

  void add_json(const MeterState&, Json& json) const override {
    const Statistics delays = delays_.statistics();
    json["samples"] = delays.count;
    add_statistics(json, "delay", delays);
    json["delay_error_ns"] = bound_json(error());
  }

  std::string text(const MeterState&) const override {
    const Statistics delays = delays_.statistics();
    if (delays.count == 0) return {};
    return fmt::format("average delay: {}\n{}{}", ns_text(delays.mean_ns),
                       statistics_line(delays, delays.count), clocks_line());
  }

  std::vector<std::string> cells(const MeterState&) const override {
    const Statistics delays = delays_.statistics();
    std::vector<std::string> cells = statistics_cells(delays);
    cells.insert(cells.begin(), delays.count > 0 ? ns_text(delays.mean_ns) : "-");
    cells.push_back(delays.count > 0 ? bound_text(error()) : "-");
    cells.push_back(std::to_string(delays.count));
    return cells;
  }

 private:
  // Greatest error of a delay that the two clocks make; 0 for a stream of this PC.
  Duration error() const {
    return errors_.size() > 0 ? errors_.statistics().max : kUnknownClockError;
  }

  std::string clocks_line() const {
    const Duration bound = error();
    if (bound == Duration::zero()) return {};  // one clock
    return bound == kUnknownClockError
               ? "\tclocks: unknown, so this may be off by any amount\n"
               : fmt::format("\tclocks: at most {} apart\n", duration_text(bound));
  }

  const RawReader& reader_;
  Window delays_, errors_;
};

}  // namespace

Result<void> run(const DelayOptions& options, Output& out) {
  constexpr auto kRight = Table::Align::right;
  return run_meter(options, out,
                   {false,
                    {{"DELAY", kRight},
                     {"MIN", kRight},
                     {"MAX", kRight},
                     {"STD DEV", kRight},
                     {"CLOCKS", kRight},
                     {"WINDOW", kRight}},
                    [&](const RawReader& reader) {
                      return std::make_unique<DelayMeter>(reader, options.window);
                    }});
}

}  // namespace dssm::ctl
