// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>
#include <dssm/time.hpp>

namespace dssm::daemon {

// So many at once, then one per period; what is not used comes back at the same rate. (The generic
// cell rate algorithm, ITU-T I.371: one time stands for the whole state.)
class RateLimiter {
 public:
  RateLimiter(int at_once, Duration period) : period_(period), ahead_((at_once - 1) * period) {}

  // How long to wait before the next one; zero: not at all.
  Duration wait(MonoTime now) const { return std::max(Duration::zero(), due_ - ahead_ - now); }
  // One is done; it did not have to wait.
  void take(MonoTime now) { due_ = std::max(due_, now) + period_; }

 private:
  Duration period_, ahead_;
  MonoTime due_{};
};

}  // namespace dssm::daemon
