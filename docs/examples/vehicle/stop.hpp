// SPDX-License-Identifier: Apache-2.0
//
// Turns Ctrl-C and SIGTERM into stop_requested(), which loops check. A wait must not take longer
// than kSlice, because a signal just before the wait does not interrupt it.
#pragma once

#include <chrono>
#include <csignal>
#include <dssm/time.hpp>

namespace vehicle {

inline constexpr dssm::Duration kSlice = std::chrono::milliseconds(200);

inline volatile std::sig_atomic_t stop_signal = 0;

inline bool stop_requested() { return stop_signal != 0; }

// Call once, at the start of main().
inline void stop_on_signals() {
  struct sigaction action {};
  action.sa_handler = [](int number) { stop_signal = number; };  // no SA_RESTART: waits end
  ::sigaction(SIGINT, &action, nullptr);
  ::sigaction(SIGTERM, &action, nullptr);
}

}  // namespace vehicle
