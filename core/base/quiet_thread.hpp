// SPDX-License-Identifier: Apache-2.0
//
// Threads with all signals blocked: a program's signal handlers run in the program's own threads,
// and Ctrl-C interrupts the wait that it is meant for.
#pragma once

#include <csignal>
#include <dssm/result.hpp>
#include <string_view>
#include <system_error>
#include <thread>
#include <utility>

namespace dssm {

// Blocks all signals in the calling thread for the object's lifetime. A thread that is started
// meanwhile inherits that.
class SignalBlock {
 public:
  SignalBlock() noexcept {
    sigset_t all;
    ::sigfillset(&all);
    ::pthread_sigmask(SIG_SETMASK, &all, &before_);
  }
  SignalBlock(const SignalBlock&) = delete;
  SignalBlock& operator=(const SignalBlock&) = delete;
  ~SignalBlock() { ::pthread_sigmask(SIG_SETMASK, &before_, nullptr); }

  const sigset_t& before() const noexcept { return before_; }

 private:
  sigset_t before_{};
};

// Starts such a thread. `what` names it in the failure: "the resolver".
template <class Body>
Result<std::thread> quiet_thread(std::string_view what, Body body) {
  const SignalBlock block;
  try {
    return std::thread(std::move(body));
  } catch (const std::system_error& failed) {
    return os_error("start a thread for " + std::string(what), failed.code().value());
  }
}

}  // namespace dssm
