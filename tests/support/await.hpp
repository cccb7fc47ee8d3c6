// SPDX-License-Identifier: Apache-2.0
//
// Waiting for what gives no sign that could be waited for, such as the state of another process.
#pragma once

#include <chrono>
#include <thread>

namespace dssm::test {

// Between two looks: who looks without a pause takes the processor from what it waits for, on a
// machine where many tests run at once.
inline constexpr auto kLookPause = std::chrono::milliseconds(1);

// Looks again and again; the test runner's time limit is the watchdog.
template <class Condition>
void await(Condition condition) {
  while (!condition()) std::this_thread::sleep_for(kLookPause);
}

}  // namespace dssm::test
