// SPDX-License-Identifier: Apache-2.0
#include "client/dssmctl/stop_signal.hpp"

#include <signal.h>

#include <atomic>

namespace dssm::ctl {
namespace {

std::atomic<bool> stop_mark{false};
static_assert(std::atomic<bool>::is_always_lock_free);  // or a handler may not touch it

void on_signal(int) { stop_mark.store(true, std::memory_order_relaxed); }

}  // namespace

void catch_stop_signals() {
  struct sigaction action {};
  action.sa_handler = on_signal;  // without SA_RESTART: waits shall end
  ::sigaction(SIGINT, &action, nullptr);
  ::sigaction(SIGTERM, &action, nullptr);
}

bool stop_requested() { return stop_mark.load(std::memory_order_relaxed); }

}  // namespace dssm::ctl
