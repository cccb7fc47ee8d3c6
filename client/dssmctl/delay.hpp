// SPDX-License-Identifier: Apache-2.0
//
// How far a delay may be off because two clocks made it: the stamp's and this PC's.
#pragma once

#include <dssm/session.hpp>
#include <string_view>
#include <vector>

#include "client/dssmctl/statistics.hpp"

namespace dssm::ctl {

class Clocks {
 public:
  // Over the newest `window` samples whose clock_error is known.
  explicit Clocks(std::size_t window) : known_errors_(window) {}

  void add(const SampleInfo& info);

  // Takes over what is known of the clocks of `hosts`. `owner`: the host whose clock makes the
  // stamps.
  void update(const std::vector<HostInfo>& hosts, std::string_view owner);

  // Whether the stamps come from another host's clock. False before update().
  bool are_two() const { return two_clocks_; }

  // Greatest error of a delay [>= 0]; kUnknownClockError: unknown. A sample's own clock_error
  // counts where it is known, else its host's clock bound; this PC's bound is added. One clock
  // alone makes no error.
  Duration delay_error() const;

 private:
  Window known_errors_;
  bool some_unknown_ = false;  // among the samples so far
  bool two_clocks_ = false;
  Duration own_bound_ = kUnknownClockError, owner_bound_ = kUnknownClockError;
};

}  // namespace dssm::ctl
