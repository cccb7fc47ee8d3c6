// SPDX-License-Identifier: Apache-2.0
//
// Signals that interrupt system calls.
#pragma once

#include <pthread.h>
#include <signal.h>

#include <atomic>
#include <thread>

namespace dssm::test {

// Sends SIGUSR1 to the thread that created it, repeatedly until it is destroyed: a single signal
// might arrive before the wait that it should interrupt.
class Signals {
 public:
  Signals() {
    struct sigaction action {};
    action.sa_handler = [](int) {};
    ::sigaction(SIGUSR1, &action, &before_);
    thread_ = std::thread([this, target = ::pthread_self()] {
      while (!done_) ::pthread_kill(target, SIGUSR1), std::this_thread::yield();
    });
  }
  Signals(const Signals&) = delete;
  Signals& operator=(const Signals&) = delete;
  ~Signals() {
    done_ = true;
    thread_.join();
    ::sigaction(SIGUSR1, &before_, nullptr);
  }

 private:
  struct sigaction before_ {};
  std::atomic<bool> done_ = false;
  std::thread thread_;
};

}  // namespace dssm::test
