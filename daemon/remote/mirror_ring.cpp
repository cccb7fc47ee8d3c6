// SPDX-License-Identifier: Apache-2.0
#include "daemon/remote/mirror_ring.hpp"

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
  if (slots_.newest() >= 0) cursor_.set_next(slots_.newest() + 1);
}

// After a gap, the slot of sample `tid` may be one that readers still read, and the payload may
// take long to arrive.
bool MirrorRing::would_overwrite_window(Tid tid) const noexcept {
  const Tid newest = slots_.newest();
  if (newest < 0) return false;
  const Tid depth = static_cast<Tid>(stream_->mapping().geometry().depth);
  const Tid same_slot = newest - (depth - (tid - newest) % depth) % depth;
  return same_slot >= reader_.oldest();
}

[[gnu::hot]] Result<std::byte*> MirrorRing::begin_untrusted(const wire::IncomingSample& sample) {
  const Tid tid = sample.info.tid;
  if (!cursor_.accepts(tid)) return cursor_.unexpected(tid);
  if (aside_) drop_aside();  // of one that was cut off
  const bool after_gap = tid != slots_.newest() + 1;
  if (after_gap && would_overwrite_window(tid)) allocate_aside(sample.payload_bytes);
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
  if (!torn) {
    const Tid tid = sample.info.tid;
    if (aside_) std::memcpy(slots_.begin(tid), aside_.get(), sample.payload_bytes);
    slots_.publish(tid, sample.info.time, sample.info.clock_error);
    cursor_.on_sample(tid);
    wake_pending_ = true;
    ++received_samples_;
    received_bytes_ += sample.payload_bytes;
  }
  // A torn sample is missing: the next one counts it, by its own tid.
  if (aside_) drop_aside();
}

[[gnu::hot]] void MirrorRing::wake() noexcept {
  if (std::exchange(wake_pending_, false)) bell_->notify();
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
  return assessor_->refusal(id_, report_.get());
}

std::string MirrorClock::reason() const {
  const ring::ClockAssessment now = assess(has_other_clocks_ != true);
  if (now.policy == ClockPolicy::off || now.can_be_good()) return {};
  return assessor_->refusal(id_, report_.get()).message;
}

}  // namespace dssm::daemon
