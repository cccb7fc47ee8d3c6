// SPDX-License-Identifier: Apache-2.0
//
// What the times in one mirror are worth, from what its owner reported of its clock, and when. Knows
// which samples are suspect: those that arrived while the owner's clock was not known, and those
// stamped against another reference than the present one.
#pragma once

#include <dssm/result.hpp>
#include <dssm/stream.hpp>
#include <memory>

#include "core/ring/clock_assessment.hpp"
#include "core/wire/clock_report.hpp"
#include "daemon/fleet/clock_assessor.hpp"

namespace dssm::daemon {

class MirrorClock {
 public:
  using Report = std::shared_ptr<const wire::ClockReport>;

  // assessor: nullptr: all times are good. Both outlive it.
  MirrorClock(const ClockAssessor* assessor, const StreamId& id) noexcept
      : assessor_(assessor), id_(id) {}

  // The owner's latest report (nullptr: none), received when `newest` was the newest sample here.
  void on_owner(Report report, Tid newest) noexcept;
  // The mirror continues with another ring, whose samples all arrive from now on.
  void on_new_ring() noexcept;

  // Whether the owner has reported. Until then the assessment by the dssmd before this one stays,
  // as long as it is valid: readers of a mirror do not notice that dssmd restarts.
  bool has_report() const noexcept { return has_report_; }

  ring::ClockAssessment assessment() const;
  // Whether the stream may be opened; always, until the owner has reported.
  //   fails  clock_out_of_bounds
  Result<void> check_opening() const;
  // Why its times are not good; empty: they are.
  std::string reason() const;

 private:
  bool is_suspect_now() const noexcept { return suspect_last_ == INT64_MAX; }

  const ClockAssessor* assessor_;
  const StreamId& id_;
  Report report_;
  bool has_report_ = false;
  Tid suspect_first_ = 0, suspect_last_ = kNoTid;
};

}  // namespace dssm::daemon
