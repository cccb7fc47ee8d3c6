// SPDX-License-Identifier: Apache-2.0
//
// Waiting in a loop until something succeeds or the person presses Ctrl-C.
#pragma once

#include <poll.h>

#include <cerrno>

#include "core/base/quiet_thread.hpp"
#include "core/base/timespec.hpp"

namespace dssm::ssm {

// Blocks signals except in pause(), so that none is missed between two checks.
class Interruptible {
 public:
  // Sleeps for `time`. False: a signal handler ran.
  bool pause(Duration time) noexcept {
    const timespec sleep = timespec_of(time);
    return !(::ppoll(nullptr, 0, &sleep, &block_.before()) < 0 && errno == EINTR);
  }

 private:
  SignalBlock block_;
};

}  // namespace dssm::ssm
