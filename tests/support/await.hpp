// SPDX-License-Identifier: Apache-2.0
//
// Polling for conditions without a notification, such as the state of another process.
#pragma once

#include <chrono>
#include <thread>

namespace dssm::test {

// The pause between two polls. Polling without a pause would take the processor from the process
// that is waited for, on a machine where many tests run at once.
inline constexpr auto kPollPause = std::chrono::milliseconds(1);

// Polls until `condition` is true; the test runner's time limit is the watchdog.
template <class Condition>
void await(Condition condition) {
  while (!condition()) std::this_thread::sleep_for(kPollPause);
}

}  // namespace dssm::test
