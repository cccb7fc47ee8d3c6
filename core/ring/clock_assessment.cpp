// SPDX-License-Identifier: Apache-2.0
#include "core/ring/clock_assessment.hpp"

#include <algorithm>

#include "core/base/time.hpp"

namespace dssm::ring {
namespace {

// What `bound` has become at an age of at most kValidFor, so that nothing overflows; rounded up.
Duration grown(Duration bound, Duration age, std::uint32_t ppb) noexcept {
  const std::int64_t ns = std::max<std::int64_t>(to_ns(age), 0);
  const std::int64_t per_billion = std::min<std::int64_t>(ppb, ClockAssessment::kMaxAgeingPpb);
  return sum(bound, Duration((ns * per_billion + 999'999'999) / 1'000'000'000));
}

}  // namespace

ClockAssessment ClockAssessment::unknown_clock(ClockPolicy policy) noexcept {
  ClockAssessment unknown;
  unknown.policy = policy;
  unknown.same_clock = 0;
  unknown.added = kUnknownClockError;
  unknown.limit = {};
  return unknown;
}

bool ClockAssessment::is_suspect(const SampleInfo& info) const noexcept {
  return info.tid >= suspect_first && info.tid <= suspect_last;
}

Duration ClockAssessment::distance(const SampleInfo& info, MonoTime now) const noexcept {
  if (same_clock) return {};
  if (assessed < now - kValidFor || info.clock_error == kForeignClockError) {
    return kUnknownClockError;
  }
  const Duration age = now - assessed;
  Duration distance = kUnknownClockError;
  if (!is_suspect(info)) distance = sum(info.clock_error, grown(added, age, ageing_ppb));
  if (info.tid < measured_first_tid) return distance;
  if (info.time >= measured_from) {
    distance = std::min(distance, grown(measured, age, measured_ageing_ppb));
  }
  if (info.time >= recent_from) {
    distance = std::min(distance, grown(recent, age, measured_ageing_ppb));
  }
  return distance;
}

bool ClockAssessment::is_good(const SampleInfo& info, MonoTime now) const noexcept {
  if (same_clock || policy == ClockPolicy::off) return true;
  if (info.clock_error == kForeignClockError) return !is_suspect(info);
  const Duration found = distance(info, now);
  return found != kUnknownClockError && found <= limit;
}

bool ClockAssessment::can_be_good() const noexcept {
  const Duration least = std::min({added, measured, recent});
  return least != kUnknownClockError && least <= limit;
}

}  // namespace dssm::ring
