// SPDX-License-Identifier: Apache-2.0
//
// Fields of a stream as curves over a range of time, thinned out so that no peak disappears.
#pragma once

#include <cstddef>
#include <cstdint>
#include <dssm/reader.hpp>
#include <dssm/recording.hpp>
#include <string>
#include <vector>

#include "client/dssmctl/fields.hpp"

namespace dssm::view {

// A curve; its three lists are of the same length. Times rise; a value that is not a number is
// before samples that follow lost ones.
struct Curve {
  std::vector<double> times_s;  // since the beginning of the range
  std::vector<double> values;
  std::vector<double> tids;
};

// Gathers the values of one field in the order of times.
class CurveBuilder {
 public:
  //   length  of the range, > 0
  //   slices  of equal length: of each the curve has the samples with the least and the greatest
  //           value
  CurveBuilder(Duration length, std::size_t slices) : length_(length), slices_(slices) {}

  // A sample at `time` since the beginning of the range; one that is before the last one is left
  // out.
  //   value     NaN: it has none
  //   is_after_gap  samples are missing before it
  void add(Duration time, Tid tid, double value, bool is_after_gap);
  Curve take();

 private:
  struct Point {
    Duration time{};
    Tid tid = kNoTid;
    double value = 0;
  };
  void end_slice();
  void put(const Point& point);

  Duration length_;
  std::size_t slices_;
  std::uint64_t slice_ = 0;  // of least_ and greatest_
  bool has_points_ = false;
  bool is_after_gap_ = false;  // the slice
  Duration last_time_ = Duration::min();
  Point least_, greatest_;
  Curve curve_;
};

// What a reader's ring, or a recording, holds of a range of time.
struct SignalRange {
  // arriving: another host's history is on its way; too_old: all of it is older than the ring's
  // samples; restarted: nothing was read.
  ReadStatus status = ReadStatus::ok;
  std::uint64_t samples = 0;   // that were read
  std::uint64_t lost = 0;      // that are missing between them
  std::uint64_t left_out = 0;  // of the range because of kMaxSignalSamples, about
  Duration clock_error{};      // the greatest bound; kUnknownClockError: unknown
  std::vector<Curve> curves;   // of each field
};

// At most so many samples are read: the last ones of the range in a ring, the first in a recording.
inline constexpr std::uint64_t kMaxSignalSamples = 500'000;

//   points  of each curve at most, about; >= 2
SignalRange read_signals(RawReader& reader, const std::vector<ctl::FieldElement>& fields, Time from,
                         Time to, std::size_t points);
// Of all incarnations.
SignalRange read_signals(RecordedRawReader& reader, const std::vector<ctl::FieldElement>& fields,
                         Time from, Time to, std::size_t points);

}  // namespace dssm::view
