// SPDX-License-Identifier: Apache-2.0
//
// Ctrl-C and SIGTERM as a question that a loop asks: "was I told to stop?". Whoever waits, waits in
// slices of kSlice at most, so that the answer is never later than that even if the signal came
// just before the wait.
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
