// SPDX-License-Identifier: Apache-2.0
#include "daemon/clock/clock_estimator.hpp"

#include <algorithm>
#include <utility>

namespace dssm::clock {
namespace {

// A clock with greater values has no bound, and sums of smaller ones do not overflow.
constexpr Duration kMaxValue = std::chrono::hours(24 * 365);

// chronyd slews by less than a tenth, and corrects no clock that is off by more.
constexpr PartsPerBillion kMaxRate = 100'000'000;

// Answers whose last measurement seems to be after now by more than this are invalid; less is a
// measurement that chronyd was just processing.
constexpr Duration kMaxAhead = std::chrono::seconds(1);

// Times of measurements that are closer than this are of the same one. chronyd takes 128 a second
// at most.
constexpr Duration kSameUpdate = std::chrono::milliseconds(1);

// A holdover begins after this many intervals without a measurement, or after the shortest.
constexpr int kIntervalsToHoldover = 4;
constexpr Duration kMinToHoldover = std::chrono::seconds(5);
constexpr Duration kMaxToHoldover = std::chrono::hours(1);

// The monotonic clock is slewed as the wall clock is. The kernel lets it run slow by a tenth and
// 500 ppm, so what it counts as a second may be 1.112 of them.
constexpr PartsPerBillion slewed(PartsPerBillion drift) noexcept { return drift + (drift + 7) / 8; }

bool in_range(Duration d) noexcept { return d >= Duration::zero() && d <= kMaxValue; }

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
    const RawTime raw = RawClock::now();
    const Time wall = WallClock::now();
    const Duration width = MonoClock::now() - before;
    if (width < best.width) best = {before, wall, width, raw};
  }
  return best;
}

std::optional<Duration> ClockEstimator::observe(const Instant& now) noexcept {
  if (!base_) {
    base_ = now;
    return {};
  }
  const Duration step = (now.wall - base_->wall) - (now.mono - base_->mono);
  const Duration blur = now.width + base_->width;
  const Duration size = std::max(step, -step);
  // The base stays: with one that moved, many small steps would not be detected.
  noise_ = size + blur;
  if (size <= kMinStep + blur) return {};
  if (!stepped_) before_step_ = base_;
  noise_ = now.width;
  setting_from_ = std::max({setting_from_, now.wall, now.wall - step});
  base_ = now;
  stepped_ = true;
  chronyd_time_.reset();
  updates_ = 0;
  if (has_answered_) forget(ClockReason::stepped);
  return step;
}

void ClockEstimator::on_source_step() noexcept {
  source_stepped_ = true;
  updates_ = 0;
  if (has_answered_) forget(ClockReason::stepped);
}

void ClockEstimator::on_source_correction(Duration by) noexcept {
  Duration& latest = source_corrected_.front();
  latest = std::min(sum(latest, by), kMaxValue);
}

bool ClockEstimator::is_nonsense(const Tracking& tracking, const Instant& answered) const noexcept {
  if (!in_range(tracking.root.dispersion) || !in_range(tracking.root.delay) ||
      !in_range(tracking.update_interval) || tracking.offset < -kMaxValue ||
      tracking.offset > kMaxValue || tracking.rate_ppb < -kMaxRate ||
      tracking.rate_ppb > kMaxRate) {
    return true;
  }
  if (tracking.leap > Tracking::kUnsynchronized) return true;
  if (tracking.leap == Tracking::kUnsynchronized) return false;
  // These times are not checked: compare before subtracting. A clock that was set back leaves the
  // last measurement in the future, which is not a fault of chronyd.
  return tracking.updated > answered.wall + kMaxValue ||
         tracking.updated < answered.wall - kMaxValue ||
         (!stepped_ && tracking.updated > answered.wall - tracking.offset + kMaxAhead);
}

ClockEstimator::Outcome ClockEstimator::take_untrusted(const Tracking& tracking, MonoTime asked,
                                                       const Instant& answered) noexcept {
  if (is_nonsense(tracking, answered)) return Outcome::nonsense;
  has_answered_ = true;
  answered_ = asked;
  // An answer from before a step is about another clock.
  if (asked >= base_->mono) find_correction(tracking, asked, answered);
  const bool local = tracking.reference_id == kLocalReferenceId;
  if (tracking.leap == Tracking::kUnsynchronized) {
    forget(ClockReason::unsynchronized);
    return Outcome::unsynchronized;
  }
  if (local && reference_) {
    // Another PC is the reference, but ours does not reach it: the last reading ages.
    if (!reading_ || reading_->tracking.reference_id == kLocalReferenceId) {
      forget(ClockReason::unsynchronized);
      return Outcome::unsynchronized;
    }
    return Outcome::taken;
  }
  // chronyd stamps by its own time, which is this clock minus the offset.
  const Duration age =
      local ? Duration::zero() : answered.wall - tracking.offset - tracking.updated;
  const MonoTime updated = std::min(answered.mono - age, asked);
  // chronyd moves the time of its last measurement along when it slews, and a step moves our own
  // idea of it: a new measurement changes both.
  const bool is_new = local || ((tracking.updated > last_update_ + kSameUpdate ||
                                 tracking.updated < last_update_ - kSameUpdate) &&
                                updated > last_updated_ + kSameUpdate);
  last_update_ = tracking.updated;
  last_updated_ = updated;
  if (is_new) {
    std::shift_right(source_corrected_.begin(), source_corrected_.end(), 1);
    source_corrected_.front() = Duration::zero();
  }
  if (stepped_ || source_stepped_) {
    if (is_new) ++updates_;
    if (updates_ < kUpdatesAfterStep) {
      forget(ClockReason::stepped);
      return Outcome::stepped;
    }
    stepped_ = source_stepped_ = false;
  }
  reading_ = {tracking, asked, updated};
  reason_ = ClockReason::none;
  return Outcome::taken;
}

// Slewing does not change chronyd's time, but a measurement does.
void ClockEstimator::find_correction(const Tracking& tracking, MonoTime asked,
                                     const Instant& answered) noexcept {
  // The offset is of some moment since the question was asked; this clock may have been slewed
  // towards chronyd's since, but not past it.
  const Duration slewed =
      std::min(growth(answered.mono - asked, kMaxRate), std::chrono::abs(tracking.offset));
  const ChronydTime now{answered.wall - tracking.offset, answered.raw, answered.width + slewed};
  const std::optional<ChronydTime> before = std::exchange(chronyd_time_, now);
  if (!before) return;
  const Duration elapsed = now.raw - before->raw;
  const Duration by =
      std::chrono::abs(now.time - before->time - elapsed - gained(elapsed, tracking.rate_ppb));
  const Duration expected = growth(elapsed, settings_.max_drift) + now.width + before->width;
  if (by >= sum(kMinCorrection, expected)) corrected_ = sum(corrected_, by);
}

void ClockEstimator::on_no_chronyd() noexcept {
  if (has_answered_) forget(ClockReason::no_chronyd);
}

void ClockEstimator::forget(ClockReason reason) noexcept {
  reading_.reset();
  reason_ = reason;
}

// How old what our chronyd states of its root may be.
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
    known.is_complete = true;
  }
}

bool ClockEstimator::follows_reference() const noexcept {
  return reading_ && reference_ && reading_->tracking.reference_id == reference_->seen_as;
}

bool ClockEstimator::is_overdue(MonoTime now) const noexcept {
  return now - reading_->updated >
         std::clamp(kIntervalsToHoldover * reading_->tracking.update_interval, kMinToHoldover,
                    kMaxToHoldover);
}

Duration ClockEstimator::own_bound() const noexcept {
  return reading_ ? sum(bound_to_root(reading_->tracking.offset, {}), noise_) : kUnknownClockError;
}

ClockSnapshot ClockEstimator::at(MonoTime now) const noexcept {
  ClockSnapshot clock;
  if (!has_answered_) return clock;
  clock.status = ClockStatus::out_of_bounds;
  clock.reason = reason_;
  if (now - answered_ > kSilentAfter) {
    if (reason_ != ClockReason::no_chronyd) clock.reason = ClockReason::silent;
    return clock;
  }
  if (!reading_) return clock;
  const Tracking& tracking = reading_->tracking;
  clock.stratum = tracking.stratum;
  clock.offset = tracking.offset;
  clock.age = now - reading_->updated;
  clock.root = tracking.root;
  if (tracking.reference_id == kLocalReferenceId) {
    clock.basis = ClockBasis::own;
    clock.bound = clock.root_bound = own_bound();
  } else {
    const bool relative = follows_reference() && reference_->is_complete;
    clock.basis = relative ? ClockBasis::reference : ClockBasis::root;
    clock.ageing_ppb = slewed(settings_.max_drift);
    // Since chronyd last learned something, not since we asked: in between it corrects by its own
    // estimate of the drift, which is not a bound.
    const Duration aged = sum(growth(clock.age, clock.ageing_ppb), noise_);
    clock.root_bound = sum(bound_to_root(tracking.offset, tracking.root), aged);
    clock.bound = relative ? sum(bound_to_reference(tracking.offset, tracking.root,
                                                    least(reference_->before, reference_->lately)),
                                 aged)
                           : clock.root_bound;
    for (const Duration by : source_corrected_) clock.bound = sum(clock.bound, by);
  }
  if (clock.bound > settings_.limit) {
    clock.reason = ClockReason::too_far;
  } else {
    clock.status = clock.basis != ClockBasis::own && is_overdue(now) ? ClockStatus::holdover
                                                                     : ClockStatus::synchronized;
  }
  return clock;
}

}  // namespace dssm::clock
