// SPDX-License-Identifier: Apache-2.0
//
// What channels ask about clocks: may samples be carried between this host and another one, and
// what are their times worth here. Answered by FleetClock; who has none asks nobody.
#pragma once

#include <cstdint>
#include <dssm/result.hpp>
#include <dssm/stream.hpp>

#include "core/base/unique_fd.hpp"
#include "core/ring/clock_gate.hpp"
#include "core/wire/clock_report.hpp"
#include "core/wire/network_protocol.hpp"

namespace dssm::daemon {

class ClockRules {
 public:
  // Looks at this PC's clock. Rises with each change that other hosts have to know before they get
  // another sample.
  virtual std::uint64_t news() = 0;

  // A heartbeat of another host has come, about each second: dssmd is awake, and may as well ask
  // chronyd now as wake up for that later.
  virtual void on_heartbeat() = 0;

  // Whether samples of the own stream `id` may be carried to and from whoever greeted so.
  //   fails  clock_out_of_bounds
  virtual Result<void> check_serving(const StreamId& id, const wire::Greeting& them) const = 0;

  // What the times in a mirror of `id` are worth here, when its owner says this of its clock
  // (nullptr: nothing). No sample is doubtful.
  virtual ring::ClockVerdict judge(const StreamId& id, const wire::ClockReport* owner) const = 0;

  // What the times in the own stream `id` are worth here when other hosts write to it, whose
  // samples carry bounds against what this clock follows.
  virtual ring::ClockVerdict judge_own(const StreamId& id) const = 0;

  // Why another host's stream is not good enough to be opened; for the log and for programs.
  virtual Error why_not(const StreamId& id, const wire::ClockReport* owner) const = 0;

  // How far that host's clock may be from this one's.
  virtual Duration distance_to(const wire::ClockReport& other) const = 0;

  // The shared page for this PC's programs, for reading (core/clock/clock_page.hpp).
  virtual Result<UniqueFd> page_for_reading() const = 0;

 protected:
  ~ClockRules() = default;
};

}  // namespace dssm::daemon
