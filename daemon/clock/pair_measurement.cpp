// SPDX-License-Identifier: Apache-2.0
#include "daemon/clock/pair_measurement.hpp"

#include <algorithm>
#include <cmath>
#include <limits>

namespace dssm::clock {
namespace {

// RawClocks count from boot: later times are invalid; differences of valid ones do not overflow.
constexpr RawTime kLastValid{std::chrono::hours(24 * 365 * 100)};

bool is_valid(RawTime t) noexcept { return t > RawTime() && t < kLastValid; }

// The limits are chosen for this time after a heartbeat: until about the next one.
constexpr Duration kChosenFor = std::chrono::seconds(1);

// For so long a difference is aged by its rates (ring::ClockAssessment::kValidFor).
constexpr Duration kAgesFor = std::chrono::seconds(3);

double ns(Duration d) noexcept { return static_cast<double>(d.count()); }

Duration rounded_up(double ns) noexcept {
  return Duration(static_cast<std::int64_t>(std::ceil(std::clamp(ns, -1e18, 1e18))));
}

PartsPerBillion rounded_up_ppb(double ppb) noexcept {
  return static_cast<PartsPerBillion>(std::ceil(ppb));
}

}  // namespace

bool PairMeasurement::add_untrusted(const HeartbeatTimes& times) noexcept {
  const std::optional<Heartbeat> newest = heartbeat_untrusted(times);
  if (!newest || (!heartbeats_.empty() && newest->answered <= heartbeats_.back().answered)) {
    return false;
  }
  if (add(*newest)) return true;
  heartbeats_ = {*newest};
  find_sides();
  return true;
}

void PairMeasurement::add_returned_untrusted(const HeartbeatTimes& times) noexcept {
  if (heartbeats_.empty() || times.asked < heartbeats_.front().answered ||
      times.answered <= heartbeats_.back().answered) {
    return;
  }
  std::optional<Heartbeat> newest = heartbeat_untrusted(times);
  if (!newest) return heartbeats_.clear();  // faster than possible: a clock stood still
  newest->round_trip.reset();
  if (!add(*newest)) heartbeats_.clear();
}

std::optional<PairMeasurement::Heartbeat> PairMeasurement::heartbeat_untrusted(
    const HeartbeatTimes& times) noexcept {
  for (const RawTime t : {times.asked, times.received, times.sent, times.answered}) {
    if (!is_valid(t)) return std::nullopt;
  }
  const Duration took = times.answered - times.asked, there = times.sent - times.received;
  if (took <= Duration::zero() || there < Duration::zero()) return std::nullopt;
  // Their clock may count up to kMaxRate more or less than this one.
  const Duration most = took - there + growth(there, kMaxRate);
  if (most < Duration::zero()) return std::nullopt;
  // The question took at most `most`, and so did the answer: by then the difference may have moved.
  const Duration moved = growth(most, kMaxRate);
  const Duration greatest = times.received.time_since_epoch() - times.asked.time_since_epoch();
  const Duration least = times.sent.time_since_epoch() - times.answered.time_since_epoch();
  return Heartbeat{times.answered,
                   {times.answered, least - moved},
                   {std::min(times.asked + most, times.answered), greatest + moved},
                   std::max(took - there, Duration::zero())};
}

bool PairMeasurement::add(const Heartbeat& newest) noexcept {
  while (!heartbeats_.empty() && (heartbeats_.size() == kMaxHeartbeats ||
                                  newest.answered - heartbeats_.front().answered > kWindow)) {
    heartbeats_.pop_front();
  }
  if (is_excluded(newest)) return false;
  heartbeats_.push_back(newest);
  find_sides();
  return above_.limit.at(newest.answered) >= -below_.limit.at(newest.answered) &&
         above_.fastest_ppb >= -below_.fastest_ppb;
}

// Whether the earlier heartbeats exclude it.
bool PairMeasurement::is_excluded(const Heartbeat& newest) const noexcept {
  if (heartbeats_.empty()) return false;
  const Duration since = newest.answered - newest.greatest.at;
  const double greatest = ns(newest.greatest.difference + growth(since, kMaxRate));
  return above_.limit.at(newest.answered) < ns(newest.least.difference) ||
         -below_.limit.at(newest.answered) > greatest;
}

void PairMeasurement::find_sides() noexcept {
  const RawTime when = heartbeats_.back().answered + kChosenFor;
  above_ = find_side(true, when);
  below_ = find_side(false, when);
}

// From each two heartbeats: the difference cannot have grown more between them than from the least
// value of the first to the greatest of the second. The same holds for the opposite difference,
// which is at least what this one is at most.
PairMeasurement::Side PairMeasurement::find_side(bool from_above, RawTime when) const noexcept {
  const auto opposite = [](Bound bound) { return Bound{bound.at, -bound.difference}; };
  Side side{{}, kMaxRate};
  double best = std::numeric_limits<double>::infinity();
  for (std::size_t j = 0; j < heartbeats_.size(); ++j) {
    const Heartbeat& second = heartbeats_[j];
    const Bound later = from_above ? second.greatest : opposite(second.least);
    const auto consider = [&](RawTime since, double rate_ppb) {
      const Limit limit{later, since, std::min(rate_ppb, static_cast<double>(kMaxRate))};
      const double then = limit.at(when);
      if (then >= best) return;
      best = then;
      side.limit = limit;
    };
    consider(later.at, kMaxRate);
    for (std::size_t i = 0; i < j; ++i) {
      const Heartbeat& first = heartbeats_[i];
      const Bound earlier = from_above ? first.least : opposite(first.greatest);
      const Duration time = later.at - earlier.at;
      if (time <= Duration::zero()) continue;
      const double mean_ppb = ns(later.difference - earlier.difference) / ns(time) * 1e9;
      consider(earlier.at, mean_ppb);
      // The rate at `when` exceeds the mean by at most what it changes since the middle of both.
      const Duration since_middle = when - later.at + time / 2;
      side.fastest_ppb =
          std::min(side.fastest_ppb, mean_ppb + kMaxRateChange * ns(since_middle) / 1e9);
    }
  }
  return side;
}

// A function whose second derivative is at most c departs from the line through its values at t and
// s by at most c / 2 * (now - t) * (now - s).
double PairMeasurement::Limit::at(RawTime now) const noexcept {
  const double time = ns(now - later.at);
  const double change_ppb = kMaxRateChange * ns(now - since) / 1e9 / 2;
  return ns(later.difference) + time * (rate_ppb + change_ppb) / 1e9;
}

std::optional<PairMeasurement::Difference> PairMeasurement::at(RawTime now) const noexcept {
  if (heartbeats_.empty()) return std::nullopt;
  const Duration age = now - heartbeats_.back().answered;
  if (age < Duration::zero() || age > kWindow) return std::nullopt;
  const double change_ppb = kMaxRateChange * ns(age - kChosenFor + kAgesFor) / 1e9;
  return Difference{-rounded_up(below_.limit.at(now)), rounded_up(above_.limit.at(now)),
                    -rounded_up_ppb(below_.fastest_ppb + change_ppb),
                    rounded_up_ppb(above_.fastest_ppb + change_ppb)};
}

Duration PairMeasurement::best_round_trip() const noexcept {
  std::optional<Duration> best;
  for (const Heartbeat& one : heartbeats_) {
    if (one.round_trip && (!best || *one.round_trip < *best)) best = one.round_trip;
  }
  return best.value_or(Duration::zero());
}

}  // namespace dssm::clock
