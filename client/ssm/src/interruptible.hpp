// SPDX-License-Identifier: Apache-2.0
//
// Waiting as old programs know it: until it works, or until the person presses Ctrl-C.
#pragma once

#include <poll.h>
#include <signal.h>

#include <algorithm>
#include <cerrno>
#include <dssm/time.hpp>

namespace dssm::ssm {

// Signals are let in only in pause(), so that none is missed between two looks.
class Interruptible {
 public:
  Interruptible() noexcept {
    sigset_t all;
    ::sigfillset(&all);
    ::pthread_sigmask(SIG_SETMASK, &all, &before_);
  }
  Interruptible(const Interruptible&) = delete;
  Interruptible& operator=(const Interruptible&) = delete;
  ~Interruptible() { ::pthread_sigmask(SIG_SETMASK, &before_, nullptr); }

  // Sleeps for `time`. False: a signal handler ran.
  bool pause(Duration time) noexcept {
    const std::int64_t ns = std::max<std::int64_t>(0, to_ns(time));
    const timespec sleep{ns / 1'000'000'000, ns % 1'000'000'000};
    return !(::ppoll(nullptr, 0, &sleep, &before_) < 0 && errno == EINTR);
  }

 private:
  sigset_t before_{};
};

}  // namespace dssm::ssm
