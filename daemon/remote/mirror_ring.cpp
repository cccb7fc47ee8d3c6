// SPDX-License-Identifier: Apache-2.0
#include "daemon/remote/mirror_ring.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <cstring>
#include <new>
#include <utility>

#include "core/base/try.hpp"

namespace dssm::daemon {
namespace {

bool is_known(const MirrorClock::Report& report) noexcept { return report && report->has_bound(); }

}  // namespace

// --- the ring

Result<std::unique_ptr<MirrorRing>> MirrorRing::open(std::shared_ptr<Stream> stream,
                                                     MemoryBudget& budget) {
  auto mapping = DSSM_TRY(stream->map_for_writing());
  auto bell = DSSM_TRY(stream->map_bell());
  return std::unique_ptr<MirrorRing>(
      new MirrorRing(std::move(stream), std::move(mapping), std::move(bell), budget));
}

MirrorRing::MirrorRing(std::shared_ptr<Stream> stream,
                       std::shared_ptr<const ring::RingMapping> mapping,
                       std::shared_ptr<ring::Bell> bell, MemoryBudget& budget)
    : stream_(std::move(stream)),
      mapping_(std::move(mapping)),
      bell_(std::move(bell)),
      budget_(budget),
      slots_(*mapping_),
      reader_(*mapping_) {
  slots_.recover();
  slots_.unmark_lost();
  slots_.shrink_hole();
  if (slots_.newest() >= 0) cursor_.set_next(slots_.newest() + 1);
}

Tid MirrorRing::depth() const noexcept {
  return static_cast<Tid>(stream_->mapping().geometry().depth);
}

// After a gap, the slot of sample `tid` may be one that readers still read, and the payload may
// take long to arrive.
bool MirrorRing::would_overwrite_window(Tid tid) const noexcept {
  const Tid newest = slots_.newest();
  if (newest < 0) return false;
  const Tid same_slot = newest - (depth() - (tid - newest) % depth()) % depth();
  return same_slot >= reader_.oldest();
}

void MirrorRing::end_filling() noexcept {
  lose_late(reader_.hole());
  wake();
}

void MirrorRing::resume(bool newest_first, bool with_history, net::Subscribe& out) {
  if (!newest_first) end_filling();
  with_history_ = with_history || !newest_first;
  lost_ahead_.clear();  // they will be sent, or reported again
  if (slots_.newest() < 0 && cursor_.next() != kNoTid) cursor_.set_next(begins_at_);
  cursor_.resume(stream_->incarnation(), out);
  out.set_newest_first(newest_first);
  const ring::TidRange hole = reader_.hole();
  const bool has_hole = !hole.is_empty() && hole.end > reader_.oldest();
  if (newest_first && slots_.newest() >= 0) {
    out.set_backlog_from(has_hole ? first_missing(backlog_from_) : backlog_from_);
  }
  if (!with_history_) {
    out.set_from_newest(true);
  } else if (has_hole) {
    out.set_from_tid(first_missing(0));
  }
  if (out.has_from_tid()) out.set_from_tid(std::max<Tid>(out.from_tid(), has_place_from_));
  if (!has_hole && with_history_) return;
  if (slots_.newest() < 0) return;
  out.set_incarnation(stream_->incarnation());
  out.set_held_from(has_hole ? hole.end : reader_.oldest());
  out.set_held_to(cursor_.next());
}

Result<void> MirrorRing::on_subscribed_untrusted(Tid first, bool newest_first, Tid oldest) {
  newest_first_ = newest_first;
  cursor_.set_thinned(newest_first);  // what is passed over comes later
  const Tid next = cursor_.next();
  const bool is_whole = with_history_ || !newest_first;
  // What has no place in a ring that is shorter than the owner's is not awaited.
  if (!is_whole) has_place_from_ = oldest_beside(std::clamp<Tid>(first, 0, channel::kMaxTid));
  const Tid held = std::max(oldest, has_place_from_);
  const Tid begin = is_whole ? first : std::clamp<Tid>(held, 0, std::max<Tid>(first, 0));
  wanted_from_ = is_whole ? 0 : first;
  if (!newest_first || next == kNoTid || slots_.newest() < 0) {
    if (newest_first) cursor_.set_next(kNoTid);
    DSSM_TRY(cursor_.on_subscribed_untrusted(first));
    begins_at_ = begin;
    return {};
  }
  lose_late({reader_.hole().begin, std::min(begin, next)});  // the owner no longer holds these
  if (begin > next) return on_gap_untrusted(next, static_cast<std::uint64_t>(begin - next));
  return {};  // continues in the hole
}

Result<void> MirrorRing::on_gap_untrusted(Tid first, std::uint64_t count) {
  if (!newest_first_) return cursor_.on_gap_untrusted(first, count);
  const Tid end = DSSM_TRY(channel::SampleCursor::end_of_gap_untrusted(first, count));
  const Tid next = cursor_.next();
  lose_late({first, std::min(end, next)});
  lose_ahead({std::max(first, next), end});
  return {};
}

// Samples before the newest one: those in the hole that are missing will not come.
void MirrorRing::lose_late(ring::TidRange range) noexcept {
  const ring::TidRange hole = reader_.hole();
  const Tid begin = std::max({range.begin, hole.begin, reader_.oldest()});
  const Tid end = std::min(range.end, hole.end);
  if (begin >= end) return;
  lost_late_ += count_missing({begin, end});
  slots_.lose_in_hole(begin, end);
  wake_pending_ = late_pending_ = true;
}

// Samples after the newest one, which have no slots yet.
void MirrorRing::lose_ahead(ring::TidRange range) {
  if (range.is_empty()) return;
  const bool follows = !lost_ahead_.empty() && lost_ahead_.back().end >= range.begin;
  if (follows || lost_ahead_.size() == kMaxLostAhead) {
    lost_ahead_.back().end = std::max(lost_ahead_.back().end, range.end);
  } else {
    lost_ahead_.push_back(range);
  }
}

// Those of the hole that leave the window before they have come, when `tid` is the newest sample.
void MirrorRing::count_what_leaves(Tid tid) noexcept {
  const ring::TidRange hole = reader_.hole();
  if (hole.is_empty()) return;
  lost_late_ += count_missing(
      {std::max(hole.begin, reader_.oldest()), std::min(hole.end, oldest_beside(tid))});
}

// What nobody wants is not missing.
std::uint64_t MirrorRing::count_missing(ring::TidRange range) const noexcept {
  std::uint64_t missing = 0;
  for (Tid tid = std::max(range.begin, wanted_from_); tid < range.end; ++tid) {
    missing += is_missing(tid) ? 1U : 0U;
  }
  return missing;
}

Time MirrorRing::newest_time() const noexcept {
  SampleInfo newest;
  static_cast<void>(reader_.stamp(reader_.newest(), newest));
  return newest.time;
}

std::uint64_t MirrorRing::filling_samples() const noexcept {
  const ring::TidRange hole = reader_.hole();
  const Tid length = hole.end - std::max(hole.begin, reader_.oldest());
  return !hole.is_empty() && length > 0 ? static_cast<std::uint64_t>(length) : 0;
}

MirrorRing::Recent MirrorRing::recent() const noexcept {
  constexpr Duration kRecent = std::chrono::seconds(3);
  Recent recent;
  SampleInfo newest, info;
  const Tid top = reader_.newest();
  if (top < 0 || reader_.stamp(top, newest) != ReadStatus::ok) return recent;
  for (Tid tid = top; tid >= std::max(reader_.oldest(), top - kMaxRecent + 1); --tid) {
    const ReadStatus status = reader_.stamp(tid, info);
    // Unsigned, because the distance of two int64 may not fit into one; and earlier runs are not
    // recent.
    const auto age_ns = static_cast<std::uint64_t>(to_ns(newest.time)) -
                        static_cast<std::uint64_t>(to_ns(info.time));
    if (status == ReadStatus::ok && age_ns > static_cast<std::uint64_t>(to_ns(kRecent))) break;
    ++recent.samples;
    recent.lost += status == ReadStatus::lost ? 1U : 0U;
  }
  return recent;
}

// The first sample of the hole, from `from` on, that is missing; if none is, the end of the hole.
Tid MirrorRing::first_missing(Tid from) const noexcept {
  const ring::TidRange hole = reader_.hole();
  Tid tid = std::max({from, hole.begin, reader_.oldest()});
  while (tid < hole.end && !is_missing(tid)) ++tid;
  return tid;
}

// Whether it is in the hole and the window, and has not come.
bool MirrorRing::is_missing(Tid tid) const noexcept {
  return reader_.hole().holds(tid) && !reader_.is_settled(tid);
}

// One that newer ones were sent before. Its slot may be in use for one of these by now.
std::byte* MirrorRing::begin_late(const wire::IncomingSample& sample) noexcept {
  is_dropped_ = !is_missing(sample.info.tid);
  // No reader looks at the slot of the sample after the newest one.
  return slots_.begin(is_dropped_ ? slots_.newest() + 1 : sample.info.tid);
}

[[gnu::hot]] Result<std::byte*> MirrorRing::begin_untrusted(const wire::IncomingSample& sample) {
  const Tid tid = sample.info.tid;
  if (newest_first_ && tid >= 0 && tid < cursor_.next()) {
    if (aside_) drop_aside();
    return begin_late(sample);
  }
  if (!cursor_.accepts(tid)) return cursor_.unexpected(tid);
  if (aside_) drop_aside();  // of one that was cut off
  const bool after_gap = tid != slots_.newest() + 1;
  if (after_gap && would_overwrite_window(tid)) allocate_aside(sample.info.payload_bytes);
  return aside_ ? aside_.get() : slots_.begin(tid);
}

// Without memory for it the sample goes to its slot: better one sample of the old window that
// cannot be read for a while than none of the new ones.
void MirrorRing::allocate_aside(std::size_t bytes) {
  Result<MemoryShare> share = budget_.take(bytes);
  if (!share) return;
  aside_.reset(new (std::nothrow) std::byte[bytes]);
  if (aside_) aside_share_ = *std::move(share);
}

void MirrorRing::drop_aside() noexcept {
  aside_.reset();
  aside_share_ = MemoryShare();
}

[[gnu::hot]] void MirrorRing::end(const wire::IncomingSample& sample, bool torn) {
  const Tid tid = sample.info.tid;
  const bool is_late = newest_first_ && tid < cursor_.next();
  if (!torn && is_late) {
    if (is_dropped_) return;
    slots_.publish_in_hole(sample.info);
    wake_pending_ = late_pending_ = true;
    ++received_samples_;
    received_bytes_ += sample.info.payload_bytes;
  } else if (!torn) {
    if (newest_first_) count_what_leaves(tid);
    if (tid != slots_.newest() + 1) slots_.make_room(tid);
    if (aside_) std::memcpy(slots_.begin(tid), aside_.get(), sample.info.payload_bytes);
    if (newest_first_ && tid != slots_.newest() + 1) {
      publish_after_gap(sample.info);
    } else {
      slots_.publish(sample.info);
    }
    lost_ahead_.clear();
    cursor_.on_sample(tid);
    wake_pending_ = true;
    ++received_samples_;
    received_bytes_ += sample.info.payload_bytes;
  }
  // A torn sample is missing: the next one counts it, by its own tid.
  if (aside_) drop_aside();
}

// Publishes a sample that does not follow on the newest one: those in between are lost, or come
// later.
void MirrorRing::publish_after_gap(const SampleInfo& info) noexcept {
  if (slots_.newest() < 0) backlog_from_ = info.tid;
  const Tid begin = std::max<Tid>(slots_.newest() + 1, begins_at_);
  const bool are_lost = lost_ahead_.size() == 1 && lost_ahead_.front().begin <= begin &&
                        lost_ahead_.front().end >= info.tid;
  if (are_lost) {
    lost_late_ += static_cast<std::uint64_t>(info.tid - begin);
    slots_.lose_before_next(info.tid, info.time);
  } else if (begin < info.tid) {
    slots_.skip_to(info.tid, begin);
  }
  slots_.publish(info);
  if (are_lost) return;
  count_what_is_passed_over({std::max(begin, wanted_from_), oldest_beside(info.tid)});
  for (const ring::TidRange& lost : lost_ahead_) {
    const Tid first = std::max(lost.begin, begin), end = std::min(lost.end, info.tid);
    if (first >= end) continue;
    lost_late_ += static_cast<std::uint64_t>(end - first);
    slots_.lose_in_hole(first, end);
    late_pending_ = true;
  }
}

// Samples that have no place any more when they come. Those that were reported as lost count there.
void MirrorRing::count_what_is_passed_over(ring::TidRange range) noexcept {
  if (range.begin >= range.end) return;
  Tid samples = range.end - range.begin;
  for (const ring::TidRange& lost : lost_ahead_) {
    const Tid begin = std::max(lost.begin, range.begin), end = std::min(lost.end, range.end);
    samples -= std::max<Tid>(end - begin, 0);
  }
  lost_late_ += static_cast<std::uint64_t>(samples);
}

[[gnu::hot]] void MirrorRing::wake() noexcept {
  if (!std::exchange(wake_pending_, false)) return;
  if (std::exchange(late_pending_, false)) {
    slots_.shrink_hole();
    // As the store of `top` does: either a sleeper that has just announced itself sees what came,
    // or this sees the announcement.
    std::atomic_thread_fence(std::memory_order_seq_cst);
  }
  bell_->notify();
}

// --- the clock

void MirrorClock::on_owner(Report report, Tid newest, MonoTime now,
                           const std::optional<OnChannel>& on_channel) {
  has_report_ = true;
  if (on_channel) has_other_clocks_ = on_channel->has_other_clocks;
  if (on_channel && report && !(settled_ && settled_->is_of(*report))) {
    settled_ = {report->setting, report->settled_from, on_channel->newest + 1};
  }
  if (report && report_ && report->boot_id == report_->boot_id &&
      report->line.raw < report_->line.raw) {
    return;
  }
  const Report before = std::exchange(report_, std::move(report));
  if (report_ && report_->boot_id != boot_id_) {
    if (!boot_id_.empty()) boot_first_ = newest + 1;
    boot_id_ = report_->boot_id;
  }
  if (before && report_ && before->boot_id == report_->boot_id &&
      before->line.left_by(report_->line) > kSlewed) {
    slewed_at_ = now;
  }
  if (!is_known(report_) || is_stale(now)) {
    // From the first sample that is not here yet. What was suspect before stays so, with all
    // samples in between.
    if (suspect_first_ > suspect_last_) suspect_first_ = newest + 1;
    suspect_last_ = INT64_MAX;
  }
  on_time(newest, now);
  if (is_known(before) && is_known(report_) && before->anchor != report_->anchor) {
    suspect_first_ = 0;
    suspect_last_ = std::max(suspect_last_, newest);
  }
}

void MirrorClock::on_time(Tid newest, MonoTime now) noexcept {
  if (is_suspect_now() && is_known(report_) && !is_stale(now)) suspect_last_ = newest;
}

void MirrorClock::on_new_ring() noexcept {
  suspect_first_ = 0;
  if (!is_suspect_now()) suspect_last_ = kNoTid;
  settled_.reset();
  boot_first_ = 0;
}

ring::ClockAssessment MirrorClock::assessment() const { return assess(has_other_clocks_ == false); }

// by_measurement: the distance of the owner's clock says something about the stream's samples.
ring::ClockAssessment MirrorClock::assess(bool by_measurement) const {
  if (!assessor_) return {};
  ring::ClockAssessment assessment = assessor_->assess_mirror(id_, report_.get());
  assessment.suspect_first = suspect_first_;
  assessment.suspect_last = suspect_last_;
  if (!by_measurement) assessment.measured = assessment.recent = kUnknownClockError;
  assessment.measured_first_tid = boot_first_;
  const Time from = std::min(assessment.measured_from, assessment.recent_from);
  if (report_ && report_->settled_from != Time() && from < report_->setting_from) {
    const bool is_known = settled_ && settled_->is_of(*report_);
    assessment.measured_first_tid =
        std::max(boot_first_, is_known ? settled_->first_tid : INT64_MAX);
  }
  return assessment;
}

Result<void> MirrorClock::check_opening() const {
  if (!has_report_) return {};
  const ring::ClockAssessment now = assess(has_other_clocks_ != true);
  if (now.policy != ClockPolicy::enforce || now.can_be_good()) return {};
  return refusal();
}

Error MirrorClock::refusal() const {
  if (has_other_clocks_ != true || !assess(true).can_be_good()) {
    return assessor_->refusal(id_, report_.get());
  }
  return Error{
      Errc::clock_out_of_bounds,
      fmt::format("stream '{}': programs on other PCs write to it, so only what chronyd states "
                  "there, on its host and here counts, not what was measured between two PCs; run "
                  "`dssmctl clock` on them, or set the key clock_policy to \"mark\" or \"off\"",
                  id_.str())};
}

std::string MirrorClock::reason() const {
  const ring::ClockAssessment now = assess(has_other_clocks_ != true);
  if (now.policy == ClockPolicy::off || now.can_be_good()) return {};
  return refusal().message;
}

}  // namespace dssm::daemon
