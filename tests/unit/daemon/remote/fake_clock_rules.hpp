// SPDX-License-Identifier: Apache-2.0
//
// Clock rules that allow what is left of 1 ms, and know no distance but what is said.
#pragma once

#include "daemon/fleet/clock_rules.hpp"

namespace dssm::daemon {

class FakeClockRules final : public ClockRules {
 public:
  std::uint64_t news() override { return 0; }
  void on_heartbeat() override {}
  Result<void> check_serving(const StreamId&, const wire::Greeting&) const override { return {}; }
  ring::ClockVerdict judge(const StreamId&, const wire::ClockReport* owner) const override {
    ring::ClockVerdict verdict;
    verdict.rule = rule;
    verdict.allowed = owner ? std::chrono::milliseconds(1) - owner->standing.bound : Duration(-1);
    return verdict;
  }
  ring::ClockVerdict judge_own(const StreamId&) const override {
    ring::ClockVerdict verdict;
    verdict.rule = rule;
    verdict.added = own_bound;
    verdict.allowed = std::chrono::milliseconds(1) - own_bound;
    verdict.judged = MonoClock::now();
    return verdict;
  }
  Error why_not(const StreamId& id, const wire::ClockReport*) const override {
    return {Errc::clock_out_of_bounds, "not '" + id.str() + "'"};
  }
  Duration distance_to(const wire::ClockReport&) const override { return {}; }
  Result<UniqueFd> page_for_reading() const override { return Error{}; }

  ring::ClockRule rule = ring::ClockRule::enforce;
  Duration own_bound{};
};

}  // namespace dssm::daemon
