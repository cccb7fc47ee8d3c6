// SPDX-License-Identifier: Apache-2.0
//
// What the times in one mirror are worth, by what its owner said of its clock and when. Knows which
// samples came while that clock was not known: their stamps are from before dssmd there noticed, or
// against another reference than the present one.
#pragma once

#include <dssm/result.hpp>
#include <dssm/stream.hpp>
#include <memory>

#include "core/ring/clock_gate.hpp"
#include "core/wire/clock_report.hpp"
#include "daemon/fleet/clock_rules.hpp"

namespace dssm::daemon {

class MirrorClock {
 public:
  using Report = std::shared_ptr<const wire::ClockReport>;

  // rules: nullptr: nobody judges. Both outlive it.
  MirrorClock(const ClockRules* rules, const StreamId& id) noexcept : rules_(rules), id_(id) {}

  // What the owner says by now (nullptr: nothing), when `newest` is the newest sample here.
  void on_owner(Report report, Tid newest) noexcept;
  // The mirror goes on with another ring, whose samples all come from now on.
  void on_new_ring() noexcept;

  // Whether the owner was heard of. Until then the verdict of the dssmd before this one stands, as
  // long as it holds: the readers of a mirror shall not notice that dssmd is restarted.
  bool is_heard() const noexcept { return heard_; }

  ring::ClockVerdict verdict() const;
  // Whether the stream may be opened; always, until the owner was heard of.
  //   fails  clock_out_of_bounds
  Result<void> check_opening() const;
  // Why its times are not good; empty: they are.
  std::string trouble() const;

 private:
  bool is_in_doubt() const noexcept { return doubtful_last_ == INT64_MAX; }

  const ClockRules* rules_;
  const StreamId& id_;
  Report report_;
  bool heard_ = false;
  Tid doubtful_first_ = 0, doubtful_last_ = kNoTid;
};

}  // namespace dssm::daemon
