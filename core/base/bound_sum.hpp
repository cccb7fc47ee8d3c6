// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <dssm/time.hpp>

namespace dssm {

// a + b for bounds on an error, both >= 0; kUnknownClockError stays that.
constexpr Duration sum(Duration a, Duration b) noexcept {
  return a > kUnknownClockError - b ? kUnknownClockError : a + b;
}

}  // namespace dssm
