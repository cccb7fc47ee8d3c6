// SPDX-License-Identifier: Apache-2.0
#include "core/clock/clock_estimator.hpp"

#include <algorithm>

namespace dssm::clock {
namespace {

// Nobody whose numbers are beyond this has a clock worth a bound, and sums of them do not overflow.
constexpr Duration kMost = std::chrono::hours(24 * 365);

// Answers whose last measurement seems to lie ahead of now by more than this are nonsense; less is
// a measurement that was just being taken in.
constexpr Duration kLeastAhead = std::chrono::seconds(1);

// Times of measurements that are closer than this are of one. chronyd takes 128 a second at most.
constexpr Duration kSameUpdate = std::chrono::milliseconds(1);

// A holdover begins after this many intervals without a measurement, or after the shortest.
constexpr int kIntervalsToHoldover = 4;
constexpr Duration kShortestToHoldover = std::chrono::seconds(5);
constexpr Duration kLongestToHoldover = std::chrono::hours(1);

// The monotonic clock is slewed as the wall clock is. The kernel lets it run slow by a tenth and
// 500 ppm, so what it counts as a second may be 1.112 of them.
constexpr PartsPerBillion slewed(PartsPerBillion drift) noexcept { return drift + (drift + 7) / 8; }

bool in_range(Duration d) noexcept { return d >= Duration::zero() && d <= kMost; }

RootDistance least(const RootDistance& a, const RootDistance& b) noexcept {
  return {std::min(a.dispersion, b.dispersion), std::min(a.delay, b.delay)};
}

}  // namespace

Instant Instant::now() noexcept {
  constexpr int kTries = 5;
  constexpr Duration kCloseEnough = std::chrono::nanoseconds(500);
  Instant best;
  best.width = Duration::max();
  for (int i = 0; i < kTries && best.width > kCloseEnough; ++i) {
    const MonoTime before = MonoClock::now();
    const Time wall = WallClock::now();
    const Duration width = MonoClock::now() - before;
    if (width < best.width) best = {before, wall, width};
  }
  return best;
}

std::optional<Duration> ClockEstimator::look(const Instant& now) noexcept {
  if (!base_) {
    base_ = now;
    return {};
  }
  const Duration step = (now.wall - base_->wall) - (now.mono - base_->mono);
  const Duration blur = now.width + base_->width;
  const Duration size = std::max(step, -step);
  // The base stays: one that moved along would let many small steps pass.
  unseen_ = size + blur;
  if (size <= kLeastStep + blur) return {};
  if (!stepped_) before_step_ = base_;
  unseen_ = now.width;
  base_ = now;
  stepped_ = true;
  updates_ = 0;
  if (heard_ever_) forget(ClockReason::stepped);
  return step;
}

bool ClockEstimator::is_nonsense(const Tracking& tracking, const Instant& answered) const noexcept {
  if (!in_range(tracking.root.dispersion) || !in_range(tracking.root.delay) ||
      !in_range(tracking.update_interval) || tracking.offset < -kMost || tracking.offset > kMost) {
    return true;
  }
  if (tracking.leap > Tracking::kUnsynchronized) return true;
  if (tracking.leap == Tracking::kUnsynchronized) return false;
  // Nobody checked these times: compare before subtracting. A clock that was set back leaves the
  // last measurement in the future, which is no fault of chronyd.
  return tracking.updated > answered.wall + kMost || tracking.updated < answered.wall - kMost ||
         (!stepped_ && tracking.updated > answered.wall - tracking.offset + kLeastAhead);
}

ClockEstimator::Verdict ClockEstimator::take_untrusted(const Tracking& tracking, MonoTime asked,
                                                       const Instant& answered) noexcept {
  if (is_nonsense(tracking, answered)) return Verdict::nonsense;
  heard_ever_ = true;
  heard_ = asked;
  const bool local = tracking.reference_id == kLocalReferenceId;
  if (tracking.leap == Tracking::kUnsynchronized) {
    forget(ClockReason::unsynchronized);
    return Verdict::unsynchronized;
  }
  if (local && reference_) {
    // Another PC is the reference, only ours does not hear it: what we knew grows old.
    if (!reading_ || reading_->tracking.reference_id == kLocalReferenceId) {
      forget(ClockReason::unsynchronized);
      return Verdict::unsynchronized;
    }
    return Verdict::taken;
  }
  // chronyd stamps by its own time, which is this clock minus the offset.
  const Duration age =
      local ? Duration::zero() : answered.wall - tracking.offset - tracking.updated;
  const MonoTime updated = std::min(answered.mono - age, asked);
  const bool is_new = local || tracking.updated > last_update_ + kSameUpdate ||
                      tracking.updated < last_update_ - kSameUpdate;
  last_update_ = tracking.updated;
  if (stepped_) {
    if (is_new) ++updates_;
    if (updates_ < kUpdatesAfterStep) {
      forget(ClockReason::stepped);
      return Verdict::stepped;
    }
    stepped_ = false;
  }
  reading_ = {tracking, asked, updated};
  why_ = ClockReason::none;
  return Verdict::taken;
}

void ClockEstimator::on_no_chronyd() noexcept {
  if (heard_ever_) forget(ClockReason::no_chronyd);
}

void ClockEstimator::forget(ClockReason why) noexcept {
  reading_.reset();
  why_ = why;
}

// How far back what our chronyd says of its root may go.
Duration ClockEstimator::memory() const noexcept {
  const Duration interval = reading_ ? reading_->tracking.update_interval : Duration::zero();
  return kMeasurementsBack *
         std::clamp(interval, Duration(std::chrono::seconds(1)), Duration(std::chrono::hours(1)));
}

void ClockEstimator::on_reference(const std::optional<ReferenceReport>& report,
                                  MonoTime now) noexcept {
  if (!report || !in_range(report->root.dispersion) || !in_range(report->root.delay)) {
    reference_.reset();
    return;
  }
  if (!reference_ || reference_->seen_as != report->seen_as) {
    reference_ = {report->seen_as, now, report->root, report->root, false};
  }
  Reference& known = *reference_;
  known.lately = least(known.lately, report->root);
  if (now - known.since >= memory()) {
    known.before = known.lately;
    known.lately = report->root;
    known.since = now;
    known.whole = true;
  }
}

bool ClockEstimator::follows_reference() const noexcept {
  return reading_ && reference_ && reading_->tracking.reference_id == reference_->seen_as;
}

bool ClockEstimator::is_overdue(MonoTime now) const noexcept {
  return now - reading_->updated >
         std::clamp(kIntervalsToHoldover * reading_->tracking.update_interval, kShortestToHoldover,
                    kLongestToHoldover);
}

ClockState ClockEstimator::at(MonoTime now) const noexcept {
  ClockState state;
  if (!heard_ever_) return state;
  state.status = ClockStatus::out_of_bounds;
  state.read = heard_;
  state.trouble = why_;
  if (now - heard_ > kSilentAfter) {
    if (why_ != ClockReason::no_chronyd) state.trouble = ClockReason::silent;
    return state;
  }
  if (!reading_) return state;
  const Tracking& tracking = reading_->tracking;
  state.stratum = tracking.stratum;
  state.reference_id = tracking.reference_id;
  state.offset = tracking.offset;
  state.updated = reading_->updated;
  state.root = tracking.root;
  state.own_bound = sum(bound_to_root(tracking.offset, {}), unseen_);
  if (tracking.reference_id == kLocalReferenceId) {
    state.basis = ClockBasis::own;
    state.bound = state.root_bound = state.own_bound;
  } else {
    const bool relative = follows_reference() && reference_->whole;
    state.basis = relative ? ClockBasis::reference : ClockBasis::root;
    state.ageing = slewed(settings_.max_drift);
    // From when chronyd last learned something, not from when we asked: in between it goes by its
    // own estimate of the drift, which is no bound.
    const Duration aged = sum(growth(now - reading_->updated, state.ageing), unseen_);
    state.root_bound = sum(bound_to_root(tracking.offset, tracking.root), aged);
    state.bound = relative ? sum(bound_to_reference(tracking.offset, tracking.root,
                                                    least(reference_->before, reference_->lately)),
                                 aged)
                           : state.root_bound;
  }
  if (state.bound > settings_.limit) {
    state.trouble = ClockReason::too_far;
  } else {
    state.status = state.basis != ClockBasis::own && is_overdue(now) ? ClockStatus::holdover
                                                                     : ClockStatus::synchronized;
  }
  return state;
}

}  // namespace dssm::clock
