// SPDX-License-Identifier: Apache-2.0
#include "daemon/clock/pair_measurement.hpp"

#include <algorithm>
#include <cmath>

namespace dssm::clock {
namespace {

// RawClocks count from boot: later times are invalid; differences of valid ones do not overflow.
constexpr RawTime kLastValid{std::chrono::hours(24 * 365 * 100)};

bool is_valid(RawTime t) noexcept { return t > RawTime() && t < kLastValid; }

// What a rate makes of a time, rounded down or up.
Duration gained(Duration age, PartsPerBillion rate, bool up) noexcept {
  const double ns = static_cast<double>(age.count()) * static_cast<double>(rate) / 1e9;
  return Duration(static_cast<std::int64_t>(up ? std::ceil(ns) : std::floor(ns)));
}

PartsPerBillion rate_of(Duration gain, Duration time, bool up) noexcept {
  const double ppb = static_cast<double>(gain.count()) / static_cast<double>(time.count()) * 1e9;
  const double limit = 2.0 * static_cast<double>(PairMeasurement::kMaxRate);
  const double clamped = std::clamp(ppb, -limit, limit);
  return static_cast<PartsPerBillion>(up ? std::ceil(clamped) : std::floor(clamped));
}

}  // namespace

void PairMeasurement::add_untrusted(const HeartbeatTimes& times) noexcept {
  if (!is_valid(times.asked) || !is_valid(times.theirs) || !is_valid(times.answered)) return;
  const Duration took = times.answered - times.asked;
  if (took <= Duration::zero()) return;
  if (!heartbeats_.empty() && times.answered <= heartbeats_.back().answered) return;
  while (!heartbeats_.empty() && (heartbeats_.size() == kMaxHeartbeats ||
                                  times.answered - heartbeats_.front().answered > kWindow)) {
    heartbeats_.pop_front();
  }
  // The difference was within the round trip's bounds at some moment of it, not just at its end.
  const Duration moved = growth(took, kMaxRate);
  const Duration ours_first = times.asked.time_since_epoch();
  const Duration ours_last = times.answered.time_since_epoch();
  const Duration theirs = times.theirs.time_since_epoch();
  const Heartbeat newest{times.answered, theirs - ours_last - moved, theirs - ours_first + moved,
                         took};
  heartbeats_.push_back(newest);
  find_rate();
  const std::optional<Difference> now = at(times.answered);
  if (slowest_ > fastest_ || now->least > now->greatest) {
    heartbeats_ = {newest};
    find_rate();
  }
}

// From each two heartbeats: the difference cannot have grown more between them than from the least
// value of the first to the greatest of the second.
void PairMeasurement::find_rate() noexcept {
  PartsPerBillion least = -kMaxRate, greatest = kMaxRate;
  for (std::size_t later = 1; later < heartbeats_.size(); ++later) {
    const Heartbeat& second = heartbeats_[later];
    for (std::size_t earlier = 0; earlier < later; ++earlier) {
      const Heartbeat& first = heartbeats_[earlier];
      const Duration time = second.answered - first.answered;
      greatest = std::min(greatest, rate_of(second.greatest - first.least, time, true));
      least = std::max(least, rate_of(second.least - first.greatest, time, false));
    }
  }
  // These are means, and the rate itself may be beyond them by all that it changes in the window.
  slowest_ = std::max(-kMaxRate, least - kMaxRateChange);
  fastest_ = std::min(kMaxRate, greatest + kMaxRateChange);
}

std::optional<PairMeasurement::Difference> PairMeasurement::at(RawTime now) const noexcept {
  Difference found{Duration::min(), Duration::max(), slowest_, fastest_};
  bool any = false;
  for (const Heartbeat& heartbeat : heartbeats_) {
    const Duration age = now - heartbeat.answered;
    if (age > kWindow || age < Duration::zero()) continue;
    any = true;
    found.least = std::max(found.least, heartbeat.least + gained(age, slowest_, false));
    found.greatest = std::min(found.greatest, heartbeat.greatest + gained(age, fastest_, true));
  }
  if (!any) return std::nullopt;
  return found;
}

Duration PairMeasurement::best_round_trip() const noexcept {
  const auto best = std::min_element(
      heartbeats_.begin(), heartbeats_.end(),
      [](const Heartbeat& a, const Heartbeat& b) { return a.round_trip < b.round_trip; });
  return best == heartbeats_.end() ? Duration::zero() : best->round_trip;
}

}  // namespace dssm::clock
