// SPDX-License-Identifier: Apache-2.0
#include "client/view/curves.hpp"

#include <algorithm>
#include <cmath>
#include <limits>

#include "client/dssmctl/text.hpp"

namespace dssm::view {
namespace {

constexpr double kNone = std::numeric_limits<double>::quiet_NaN();

double seconds(Duration duration) { return std::chrono::duration<double>(duration).count(); }

}  // namespace

void CurveBuilder::add(Duration time, Tid tid, double value, bool is_after_gap) {
  if (time < last_time_) return;
  last_time_ = time;
  const double part = seconds(time) / seconds(length_);
  const auto slice =
      static_cast<std::uint64_t>(std::clamp(part, 0.0, 1.0) * static_cast<double>(slices_));
  const Point point{time, tid, value};
  if (!has_points_ || slice != slice_ || std::isnan(value) || std::isnan(least_.value)) {
    end_slice();
    slice_ = slice;
    is_after_gap_ = is_after_gap;
    least_ = greatest_ = point;
    has_points_ = true;
    return;
  }
  is_after_gap_ = is_after_gap_ || is_after_gap;
  if (value < least_.value) least_ = point;
  if (value > greatest_.value) greatest_ = point;
}

void CurveBuilder::end_slice() {
  if (!has_points_) return;
  const bool is_rising = least_.tid <= greatest_.tid;
  const Point& first = is_rising ? least_ : greatest_;
  if (is_after_gap_) put({first.time, first.tid, kNone});
  put(first);
  if (least_.tid != greatest_.tid) put(is_rising ? greatest_ : least_);
  has_points_ = false;
}

void CurveBuilder::put(const Point& point) {
  curve_.times_s.push_back(seconds(point.time));
  curve_.values.push_back(point.value);
  curve_.tids.push_back(static_cast<double>(point.tid));
}

Curve CurveBuilder::take() {
  end_slice();
  return std::move(curve_);
}

SignalRange read_signals(RawReader& reader, const std::vector<ctl::FieldElement>& fields, Time from,
                         Time to, std::size_t points) {
  SignalRange range;
  // The samples before and after the range, so that a line enters and leaves it.
  SampleInfo info;
  Tid first = reader.oldest_tid();
  const ReadStatus at_begin = reader.find(from, info);
  if (at_begin == ReadStatus::ok) first = info.tid;
  if (at_begin == ReadStatus::arriving) range.status = at_begin;
  Tid last = reader.newest_tid();
  const ReadStatus at_end = reader.find(to, info);
  if (at_end == ReadStatus::ok) last = std::min(last, info.tid + 1);
  if (at_end == ReadStatus::too_old) {  // the ring has nothing of that time any more
    range.status = at_end;
    return range;
  }
  if (first == kNoTid || last == kNoTid) return range;
  const Tid oldest_read = last - static_cast<Tid>(kMaxSignalSamples);
  range.left_out = static_cast<std::uint64_t>(std::max<Tid>(oldest_read - first, 0));
  first = std::max(first, oldest_read);

  const std::size_t wanted = std::max<std::size_t>(points, 2);
  const bool is_thinned = static_cast<std::uint64_t>(last - first) >= wanted;
  const Duration length = std::max(ctl::saturating_sub(to, from), Duration(1));
  std::vector<CurveBuilder> builders;
  for (std::size_t i = 0; i < fields.size(); ++i) {
    // Without thinning each sample has a slice of its own.
    builders.emplace_back(length,
                          is_thinned ? wanted / 2 : std::numeric_limits<std::uint32_t>::max());
  }
  bool is_after_gap = false;
  std::vector<double> values(fields.size());
  for (Tid tid = first; tid <= last; ++tid) {
    BorrowedSample sample;
    const ReadStatus status = reader.borrow(tid, sample);
    if (status == ReadStatus::restarted) {
      range.status = status;
      return range;
    }
    bool is_read = status == ReadStatus::ok;
    if (is_read) {
      for (std::size_t i = 0; i < fields.size(); ++i) {
        values[i] =
            ctl::element_number(sample.payload(), fields[i].field, fields[i].element.value_or(0))
                .value_or(kNone);
      }
      is_read = sample.still_valid();
    }
    if (!is_read) {
      if (status == ReadStatus::not_yet) break;
      if (status == ReadStatus::arriving) range.status = status;
      range.lost += status != ReadStatus::arriving;
      is_after_gap = range.samples > 0;
      continue;
    }
    ++range.samples;
    range.clock_error = std::max(range.clock_error, reader.clock_error(sample.info()));
    const Duration time = ctl::saturating_sub(sample.info().time, from);
    for (std::size_t i = 0; i < fields.size(); ++i) {
      builders[i].add(time, tid, values[i], is_after_gap);
    }
    is_after_gap = false;
  }
  for (CurveBuilder& builder : builders) range.curves.push_back(builder.take());
  return range;
}

}  // namespace dssm::view
