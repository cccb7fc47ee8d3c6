// SPDX-License-Identifier: Apache-2.0
#include "daemon/remote/mirror_clock.hpp"

#include <algorithm>
#include <utility>

namespace dssm::daemon {
namespace {

bool is_known(const MirrorClock::Report& report) noexcept {
  return report && report->standing.bound != kUnknownClockError;
}

}  // namespace

void MirrorClock::on_owner(Report report, Tid newest) noexcept {
  has_report_ = true;
  const Report before = std::exchange(report_, std::move(report));
  if (!is_known(report_)) {
    // From the first sample that is not here yet. What was suspect before stays so, with all
    // samples in between.
    if (suspect_first_ > suspect_last_) suspect_first_ = newest + 1;
    suspect_last_ = INT64_MAX;
  } else if (is_suspect_now()) {
    suspect_last_ = newest;
  } else if (is_known(before) && before->standing.anchor != report_->standing.anchor) {
    suspect_first_ = 0;
    suspect_last_ = newest;
  }
}

void MirrorClock::on_new_ring() noexcept {
  suspect_first_ = 0;
  if (!is_suspect_now()) suspect_last_ = kNoTid;
}

ring::ClockAssessment MirrorClock::assessment() const {
  if (!assessor_) return {};
  ring::ClockAssessment assessment = assessor_->assess_mirror(id_, report_.get());
  assessment.suspect_first = suspect_first_;
  assessment.suspect_last = suspect_last_;
  return assessment;
}

Result<void> MirrorClock::check_opening() const {
  if (!has_report_) return {};
  const ring::ClockAssessment now = assessment();
  if (now.policy != ClockPolicy::enforce || now.limit >= Duration::zero()) return {};
  return assessor_->refusal(id_, report_.get());
}

std::string MirrorClock::reason() const {
  const ring::ClockAssessment now = assessment();
  if (now.policy == ClockPolicy::off || now.limit >= Duration::zero()) return {};
  return assessor_->refusal(id_, report_.get()).message;
}

}  // namespace dssm::daemon
