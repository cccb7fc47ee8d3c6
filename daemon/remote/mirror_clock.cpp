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
  heard_ = true;
  const Report before = std::exchange(report_, std::move(report));
  if (!is_known(report_)) {
    // From the first sample on that we do not have yet; what was in doubt before stays so, with all
    // in between.
    if (doubtful_first_ > doubtful_last_) doubtful_first_ = newest + 1;
    doubtful_last_ = INT64_MAX;
  } else if (is_in_doubt()) {
    doubtful_last_ = newest;
  } else if (is_known(before) && before->standing.anchor != report_->standing.anchor) {
    doubtful_first_ = 0;
    doubtful_last_ = newest;
  }
}

void MirrorClock::on_new_ring() noexcept {
  doubtful_first_ = 0;
  if (!is_in_doubt()) doubtful_last_ = kNoTid;
}

ring::ClockVerdict MirrorClock::verdict() const {
  if (!rules_) return {};
  ring::ClockVerdict verdict = rules_->judge(id_, report_.get());
  verdict.doubtful_first = doubtful_first_;
  verdict.doubtful_last = doubtful_last_;
  return verdict;
}

Result<void> MirrorClock::check_opening() const {
  if (!heard_) return {};
  const ring::ClockVerdict now = verdict();
  if (now.rule != ring::ClockRule::enforce || now.allowed >= Duration::zero()) return {};
  return rules_->why_not(id_, report_.get());
}

std::string MirrorClock::trouble() const {
  const ring::ClockVerdict now = verdict();
  const bool is_judged = now.rule == ring::ClockRule::enforce || now.rule == ring::ClockRule::mark;
  if (!is_judged || now.allowed >= Duration::zero()) return {};
  return rules_->why_not(id_, report_.get()).message;
}

}  // namespace dssm::daemon
