// SPDX-License-Identifier: Apache-2.0
//
// What hz, bw and delay have in common: following the stamps of one or several streams, without
// ever touching a payload, and reporting at intervals. One stream has a block of lines per report,
// several have a table; as JSON each stream has a line per report.
#pragma once

#include <cstdint>
#include <deque>
#include <dssm/session.hpp>
#include <functional>
#include <memory>
#include <optional>
#include <string>
#include <vector>

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
  std::uint64_t late = 0;      // newer ones came before them, and they are not measured, likewise
  std::uint64_t restarts = 0;  // of the stream, since the start
  Duration age{};              // of the newest sample seen; meaningless while seen is 0
  std::optional<Duration> paused;   // length of the newest pause that ended since the last report
  std::optional<Duration> stalled;  // no sample came for so long, which is longer than usual
  bool empty = false;               // the stream has no samples
  bool arriving = false;            // newer ones are here than those that were read
  bool final = false;               // the last one, not after an interval
};

// Finds pauses by the intervals between samples, as dssmd finds stalled streams: pause_length().
class PauseDetector {
 public:
  explicit PauseDetector(Duration cycle) : cycle_(cycle) {}

  // The length of the pause before a sample with this stamp, if there was one.
  std::optional<Duration> on_sample(Time time);
  // The next sample does not follow the last one.
  void on_gap() { previous_.reset(); }
  Duration length() const;

 private:
  Duration cycle_;
  std::optional<Time> previous_;
  std::deque<Duration> recent_;  // the newest intervals, pauses included: a stream may be irregular
};

// What is measured of one stream.
class Meter {
 public:
  virtual ~Meter() = default;

  virtual void on_sample(const SampleInfo& info, Time arrival) = 0;
  // The next sample does not follow the last one.
  virtual void on_gap() {}
  // There was a pause before the next sample: what was measured before is over.
  virtual void on_pause() {}

  // A report: the keys after the common ones; lines for people, the only stream's; and the cells of
  // a table's row after the stream's name and before the note.
  virtual void add_json(const MeterState& state, Json& json) const = 0;
  virtual std::string text(const MeterState& state) const = 0;
  virtual std::vector<std::string> cells(const MeterState& state) const = 0;
};

struct MeterKind {
  // Whether to begin with the samples that the ring holds already; then the first report comes as
  // soon as there are two samples of a stream, not after an interval. And whether to wait for those
  // that come after newer ones; else they are not measured, so that what came waits for nothing.
  bool from_history = false;
  std::vector<Table::Column> columns;  // of Meter::cells()
  // `reader` outlives the meter.
  std::function<std::unique_ptr<Meter>(const RawReader& reader)> make;
};

// Runs until `options.count` reports are made; or until Ctrl-C or the end of all streams, with one
// more report. Fails when a stream has ended, after all others have.
Result<void> run_meter(const MeterOptions& options, Output& out, const MeterKind& kind);

// Adds NAME_mean_ns, NAME_min_ns, NAME_max_ns and NAME_std_dev_ns; null while nothing was measured.
void add_statistics(Json& json, const std::string& name, const Statistics& statistics);

// "\tmin: 1.00 ms max: ... window: 12\n", for people.
std::string statistics_line(const Statistics& statistics, std::size_t window);

// "1.00 ms", or "-" when nothing was measured: minimum, maximum and standard deviation.
std::vector<std::string> statistics_cells(const Statistics& statistics);

}  // namespace dssm::ctl
