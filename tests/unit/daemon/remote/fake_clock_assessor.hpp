// SPDX-License-Identifier: Apache-2.0
//
// Has a limit of 1 ms, and knows no distance but the bound that is stated.
#pragma once

#include "daemon/fleet/clock_assessor.hpp"

namespace dssm::daemon {

class FakeClockAssessor final : public ClockAssessor {
 public:
  std::uint64_t clock_generation() override { return generation; }
  Result<void> check_serving(const StreamId&, const wire::Greeting&) const override { return {}; }
  ring::ClockAssessment assess_mirror(const StreamId&,
                                      const wire::ClockReport* owner) const override {
    if (same_clock) return {};
    ring::ClockAssessment assessment = ring::ClockAssessment::unknown_clock(policy);
    assessment.limit = std::chrono::milliseconds(1);
    assessment.measured = assessment.recent = measured;
    assessment.measured_from = assessment.recent_from = measured_from;
    if (owner) assessment.added = owner->clock.bound;
    return assessment;
  }
  ring::ClockAssessment assess_own(const StreamId&) const override {
    ring::ClockAssessment assessment = ring::ClockAssessment::unknown_clock(policy);
    assessment.added = own_bound;
    assessment.limit = std::chrono::milliseconds(1);
    assessment.assessed = MonoClock::now();
    return assessment;
  }
  Error refusal(const StreamId& id, const wire::ClockReport*) const override {
    return {Errc::clock_out_of_bounds, "not '" + id.str() + "'"};
  }
  std::vector<ClockPair> clock_pairs() override { return pairs; }

  std::uint64_t generation = 0;
  std::vector<ClockPair> pairs;
  ClockPolicy policy = ClockPolicy::enforce;
  bool same_clock = false;
  Duration own_bound{};
  Duration measured = kUnknownClockError;
  Time measured_from{};
};

}  // namespace dssm::daemon
