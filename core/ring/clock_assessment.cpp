// SPDX-License-Identifier: Apache-2.0
#include "core/ring/clock_assessment.hpp"

#include <algorithm>

#include "core/base/time.hpp"

namespace dssm::ring {

ClockAssessment ClockAssessment::unknown_clock(ClockPolicy policy) noexcept {
  ClockAssessment unknown;
  unknown.policy = policy;
  unknown.same_clock = 0;
  unknown.added = kUnknownClockError;
  unknown.limit = Duration(-1);
  return unknown;
}

bool ClockAssessment::is_suspect(const SampleInfo& info) const noexcept {
  return info.tid >= suspect_first && info.tid <= suspect_last;
}

bool ClockAssessment::is_trusted(const SampleInfo& info, MonoTime now) const noexcept {
  return !is_suspect(info) && assessed >= now - kValidFor;
}

// Only of one that is_trusted(), so that nothing overflows; rounded up.
Duration ClockAssessment::grown_by(MonoTime now) const noexcept {
  const std::int64_t age = std::max<std::int64_t>(to_ns(now - assessed), 0);
  return Duration((age * ageing_ppb + 999'999'999) / 1'000'000'000);
}

Duration ClockAssessment::distance(const SampleInfo& info, MonoTime now) const noexcept {
  if (same_clock) return {};
  if (!is_trusted(info, now) || info.clock_error == kForeignClockError) return kUnknownClockError;
  return sum(info.clock_error, sum(added, grown_by(now)));
}

bool ClockAssessment::is_good(const SampleInfo& info, MonoTime now) const noexcept {
  if (same_clock || policy == ClockPolicy::off) return true;
  if (info.clock_error == kForeignClockError) return !is_suspect(info);
  return is_trusted(info, now) && sum(info.clock_error, grown_by(now)) <= limit;
}

}  // namespace dssm::ring
