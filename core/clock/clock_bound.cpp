// SPDX-License-Identifier: Apache-2.0
#include "core/clock/clock_bound.hpp"

#include <algorithm>
#include <limits>

namespace dssm::clock {
namespace {

constexpr Duration kNone = Duration::zero();

Duration magnitude(Duration offset) noexcept {
  return offset == Duration::min() ? kUnknownClockError : std::max(offset, -offset);
}

Duration half(Duration d) noexcept { return d / 2 + d % 2; }

// own - reference where that is known and positive; all of `own` without a usable reference.
Duration beyond(Duration own, Duration reference) noexcept {
  if (own == kUnknownClockError) return own;
  return own - std::clamp(reference, kNone, std::max(own, kNone));
}

}  // namespace

Duration bound_to_root(Duration offset, const RootDistance& own) noexcept {
  return bound_to_reference(offset, own, {});
}

Duration bound_to_reference(Duration offset, const RootDistance& own,
                            const RootDistance& reference) noexcept {
  const Duration delay = beyond(own.delay, reference.delay);
  return sum(sum(magnitude(offset), beyond(own.dispersion, reference.dispersion)),
             delay == kUnknownClockError ? delay : half(delay));
}

Duration growth(Duration age, PartsPerBillion drift) noexcept {
  if (age <= kNone) return kNone;
  constexpr std::int64_t kBillion = 1'000'000'000, kMax = std::numeric_limits<std::int64_t>::max();
  // Whole seconds and the rest apart, so that neither product overflows for an honest age.
  const std::int64_t seconds = age.count() / kBillion, rest = age.count() % kBillion;
  if (drift > kMax / kBillion || (drift > 0 && seconds > (kMax - 2 * drift) / drift)) {
    return kUnknownClockError;
  }
  return Duration(seconds * drift + (rest * drift + kBillion - 1) / kBillion);
}

Duration gained(Duration age, PartsPerBillion rate) noexcept {
  return Duration(static_cast<std::int64_t>(static_cast<double>(age.count()) *
                                            static_cast<double>(rate) / 1e9));
}

}  // namespace dssm::clock
