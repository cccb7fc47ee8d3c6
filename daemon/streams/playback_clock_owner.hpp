// SPDX-License-Identifier: Apache-2.0
//
// Owns the one playback clock of this PC (core/clock/playback_record.hpp). It is made when first
// requested, or after a restart of dssmd taken back from the first program that still has it.
#pragma once

#include <dssm/result.hpp>
#include <functional>

#include "core/base/unique_fd.hpp"

namespace dssm::daemon {

class PlaybackClockOwner {
 public:
  bool has_one() const noexcept { return static_cast<bool>(clock_); }

  // Takes `offered` when there is no clock yet and it is one that dssmd created.
  //   fails  protocol, no_permission; also when there is one already and it is not the same:
  //          conflict. The clock that counts is what get() gives.
  Result<void> adopt_untrusted(UniqueFd offered);

  // A descriptor (read and write) for a client; its own.
  Result<UniqueFd> get();

  // Called with each new clock from now on; {}: no call.
  void on_new_clock(std::function<void(int fd)> then) { on_new_clock_ = std::move(then); }

 private:
  void take(UniqueFd clock);

  UniqueFd clock_;
  std::function<void(int)> on_new_clock_;
};

}  // namespace dssm::daemon
