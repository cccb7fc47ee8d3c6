// SPDX-License-Identifier: Apache-2.0
//
// What the ends of connections ask about clocks: may samples be carried between this host and
// another one, and what are their times worth here. FleetClock answers. Where it is absent
// (nullptr), every sample is carried and counts as good.
#pragma once

#include <cstdint>
#include <dssm/result.hpp>
#include <dssm/stream.hpp>
#include <vector>

#include "core/ring/clock_assessment.hpp"
#include "core/wire/clock_report.hpp"
#include "core/wire/network_protocol.hpp"

namespace dssm::daemon {

class ClockAssessor {
 public:
  // Checks this PC's clock. The number rises with each change that another host has to know before
  // it gets another sample.
  virtual std::uint64_t clock_generation() = 0;

  // Whether samples of the own stream `id` may be carried to and from the client that sent `them`.
  //   fails  clock_out_of_bounds
  virtual Result<void> check_serving(const StreamId& id, const wire::Greeting& them) const = 0;

  // What the times in a mirror of `id` are worth here when its owner reports `owner` (nullptr:
  // nothing). No sample is suspect.
  virtual ring::ClockAssessment assess_mirror(const StreamId& id,
                                              const wire::ClockReport* owner) const = 0;

  // What the times in the own stream `id` are worth here when other hosts write to it, whose
  // samples carry bounds against what this clock follows.
  virtual ring::ClockAssessment assess_own(const StreamId& id) const = 0;

  // Why a mirror of `id` is not good enough to be opened; for the log and for programs.
  virtual Error refusal(const StreamId& id, const wire::ClockReport* owner) const = 0;

  // What is stated here of the samples of each other host that is up, at most wire::kMaxClockPairs.
  // Checks this PC's clock first. Without `reader`.
  virtual std::vector<ClockPair> clock_pairs() = 0;

 protected:
  ~ClockAssessor() = default;
};

}  // namespace dssm::daemon
