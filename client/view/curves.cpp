// SPDX-License-Identifier: Apache-2.0
#include "client/view/curves.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <optional>
#include <span>
#include <utility>

#include "client/dssmctl/text.hpp"
#include "client/view/streams.hpp"

namespace dssm::view {
namespace {

constexpr double kNone = std::numeric_limits<double>::quiet_NaN();

double seconds(Duration duration) { return std::chrono::duration<double>(duration).count(); }

// Makes a range of the samples that are read one after the other.
class RangeBuilder {
 public:
  //   count  of samples in the range, about; none: not known
  RangeBuilder(const std::vector<ctl::FieldElement>& fields, Time from, Time to, std::size_t points,
               std::optional<std::uint64_t> count)
      : fields_(fields), from_(from), values_(fields.size()) {
    const std::size_t wanted = std::max<std::size_t>(points, 2);
    const bool is_thinned = !count || *count >= wanted;
    const Duration length = std::max(ctl::saturating_sub(to, from), Duration(1));
    // Without thinning each sample has a slice of its own.
    const std::size_t slices = is_thinned ? wanted / 2 : std::numeric_limits<std::uint32_t>::max();
    builders_.assign(fields.size(), CurveBuilder(length, slices));
  }

  // The values of a sample, for the next add(): a borrowed sample must be checked in between.
  void read(std::span<const std::byte> payload) {
    for (std::size_t i = 0; i < fields_.size(); ++i) {
      values_[i] = ctl::element_number(payload, fields_[i].field, fields_[i].element.value_or(0))
                       .value_or(kNone);
    }
  }
  void add(const SampleInfo& info, Duration clock_error) {
    ++range.samples;
    range.clock_error = std::max(range.clock_error, clock_error);
    const Duration time = ctl::saturating_sub(info.time, from_);
    for (std::size_t i = 0; i < fields_.size(); ++i) {
      builders_[i].add(time, info.tid, values_[i], is_after_gap_);
    }
    is_after_gap_ = false;
  }
  void add_gap() { is_after_gap_ = range.samples > 0; }

  SignalRange take() {
    for (CurveBuilder& builder : builders_) range.curves.push_back(builder.take());
    return std::move(range);
  }

  SignalRange range;

 private:
  const std::vector<ctl::FieldElement>& fields_;
  Time from_;
  std::vector<double> values_;
  std::vector<CurveBuilder> builders_;
  bool is_after_gap_ = false;
};

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
  const bool is_rising = least_.time <= greatest_.time;
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

  RangeBuilder builder(fields, from, to, points, static_cast<std::uint64_t>(last - first));
  builder.range = range;
  for (Tid tid = first; tid <= last; ++tid) {
    BorrowedSample sample;
    const ReadStatus status = reader.borrow(tid, sample);
    if (status == ReadStatus::restarted) {
      range = {};
      range.status = status;
      return range;
    }
    if (status == ReadStatus::not_yet) break;
    if (status == ReadStatus::ok) {
      builder.read(sample.payload());
      if (sample.still_valid()) {
        builder.add(sample.info(), reader.clock_error(sample.info()));
        continue;
      }
    }
    if (status == ReadStatus::arriving) {
      builder.range.status = status;
    } else {
      ++builder.range.lost;
    }
    builder.add_gap();
  }
  return builder.take();
}

SignalRange read_signals(RecordedRawReader& reader, const std::vector<ctl::FieldElement>& fields,
                         Time from, Time to, std::size_t points) {
  std::vector<std::byte> payload(reader.payload_bytes());
  SampleInfo info;
  const std::uint64_t lost_before = reader.lost_samples();
  // The samples before and after the range, so that a line enters and leaves it.
  ReadStatus status = past_restarts([&] { return reader.read_at(from, payload, info); });
  if (status != ReadStatus::ok) {
    status = past_restarts([&] { return reader.read_at_or_after(from, payload, info); });
  }
  reader.seek(info.tid);
  SampleInfo last;
  std::optional<std::uint64_t> count;
  if (reader.find(to, last) == ReadStatus::ok && last.tid >= info.tid) {
    count = static_cast<std::uint64_t>(last.tid - info.tid);
  }
  RangeBuilder builder(fields, from, to, points, count);
  while (status == ReadStatus::ok) {
    if (builder.range.samples >= kMaxSignalSamples) {
      builder.range.left_out = static_cast<std::uint64_t>(std::max<Tid>(last.tid - info.tid, 1));
      break;
    }
    builder.read(std::span(payload).first(info.payload_bytes));
    builder.add(info, reader.clock_error(info));
    if (info.time > to) break;
    const Tid before = info.tid;
    status = reader.read_next(payload, info);
    if (status == ReadStatus::restarted) {
      status = past_restarts([&] { return reader.read_next(payload, info); });
      builder.add_gap();
    } else if (status == ReadStatus::ok && info.tid != before + 1) {
      builder.add_gap();
    }
  }
  builder.range.lost = reader.lost_samples() - lost_before;
  return builder.take();
}

}  // namespace dssm::view
