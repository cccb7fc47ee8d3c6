// SPDX-License-Identifier: Apache-2.0
#include "core/ring/clock_gate.hpp"

#include <algorithm>

#include "core/base/bound_sum.hpp"

namespace dssm::ring {
namespace {

constexpr int kTries = 1000;

}  // namespace

bool ClockVerdict::is_doubtful(const SampleInfo& info) const noexcept {
  return info.tid >= doubtful_first && info.tid <= doubtful_last;
}

bool ClockVerdict::is_believed(const SampleInfo& info, MonoTime now) const noexcept {
  return !is_doubtful(info) && now - judged <= kHolds;
}

// Within kHolds, so that nothing overflows; rounded up.
Duration ClockVerdict::grown_by(MonoTime now) const noexcept {
  const std::int64_t age = std::max<std::int64_t>(to_ns(now - judged), 0);
  return Duration((age * ageing_ppb + 999'999'999) / 1'000'000'000);
}

Duration ClockVerdict::distance(const SampleInfo& info, MonoTime now) const noexcept {
  if (rule == ClockRule::none || rule == ClockRule::same_clock) return {};
  if (!is_believed(info, now) || info.clock_error == kForeignClockError) return kUnknownClockError;
  return sum(info.clock_error, sum(added, grown_by(now)));
}

bool ClockVerdict::is_good(const SampleInfo& info, MonoTime now) const noexcept {
  if (rule != ClockRule::mark && rule != ClockRule::enforce) return true;
  if (info.clock_error == kForeignClockError) return !is_doubtful(info);
  return is_believed(info, now) && info.clock_error <= allowed - grown_by(now);
}

void store(ClockGate& gate, const ClockVerdict& verdict) noexcept {
  // Odd also after a dssmd that died in the middle.
  const std::uint64_t writing = gate.sequence.load(std::memory_order_relaxed) | 1;
  gate.sequence.store(writing, std::memory_order_relaxed);
  // Release, each: a reader that sees one of these sees the odd sequence too.
  gate.rule.store(static_cast<std::uint32_t>(verdict.rule), std::memory_order_release);
  gate.added_ns.store(to_ns(verdict.added), std::memory_order_release);
  gate.allowed_ns.store(to_ns(verdict.allowed), std::memory_order_release);
  gate.ageing_ppb.store(verdict.ageing_ppb, std::memory_order_release);
  gate.judged_ns.store(to_ns(verdict.judged.time_since_epoch()), std::memory_order_release);
  gate.doubtful_first.store(verdict.doubtful_first, std::memory_order_release);
  gate.doubtful_last.store(verdict.doubtful_last, std::memory_order_release);
  gate.sequence.store(writing + 1, std::memory_order_release);
}

ClockVerdict load(const ClockGate& gate) noexcept {
  for (int i = 0; i < kTries; ++i) {
    const std::uint64_t before = gate.sequence.load(std::memory_order_acquire);
    if (before == 0) return {};
    ClockVerdict verdict;
    verdict.rule = static_cast<ClockRule>(gate.rule.load(std::memory_order_acquire));
    verdict.added = Duration(gate.added_ns.load(std::memory_order_acquire));
    verdict.allowed = Duration(gate.allowed_ns.load(std::memory_order_acquire));
    verdict.ageing_ppb = gate.ageing_ppb.load(std::memory_order_acquire);
    verdict.judged = MonoTime(Duration(gate.judged_ns.load(std::memory_order_acquire)));
    verdict.doubtful_first = gate.doubtful_first.load(std::memory_order_acquire);
    verdict.doubtful_last = gate.doubtful_last.load(std::memory_order_acquire);
    if (before % 2 == 0 && gate.sequence.load(std::memory_order_relaxed) == before) {
      return verdict;
    }
  }
  ClockVerdict nothing;
  nothing.rule = static_cast<ClockRule>(gate.rule.load(std::memory_order_relaxed));
  nothing.allowed = Duration(-1);
  return nothing;
}

}  // namespace dssm::ring
