// SPDX-License-Identifier: Apache-2.0
#include "daemon/base/rate_limiter.hpp"

#include <gtest/gtest.h>

namespace dssm::daemon {
namespace {

using namespace std::chrono_literals;

constexpr MonoTime kBegin{1000s};

// How many may go at that moment.
int take_all(RateLimiter& pace, MonoTime now) {
  int count = 0;
  for (; pace.wait(now) == Duration::zero(); ++count) pace.take(now);
  return count;
}

TEST(RateLimiter, LetsSoManyGoAtOnceAndThenOnePerPeriod) {
  RateLimiter pace(4, 100ms);
  EXPECT_EQ(take_all(pace, kBegin), 4);
  EXPECT_EQ(pace.wait(kBegin), 100ms);
  EXPECT_EQ(pace.wait(kBegin + 30ms), 70ms);
  EXPECT_EQ(take_all(pace, kBegin + 99ms), 0);
  EXPECT_EQ(take_all(pace, kBegin + 100ms), 1);
  EXPECT_EQ(take_all(pace, kBegin + 300ms), 2);
}

TEST(RateLimiter, HasAllOfThemAgainAfterARestAndNotMore) {
  RateLimiter pace(4, 100ms);
  EXPECT_EQ(take_all(pace, kBegin), 4);
  EXPECT_EQ(take_all(pace, kBegin + 399ms), 3);
  EXPECT_EQ(take_all(pace, kBegin + 10s), 4);
}

TEST(RateLimiter, SumsUpWhatIsLeftOut) {
  RateLimiter lines(1, 10s);
  EXPECT_EQ(lines.admit(kBegin, 5), 5u);
  EXPECT_EQ(lines.admit(kBegin + 1s, 7), std::nullopt);
  EXPECT_EQ(lines.admit(kBegin + 9s, 2), std::nullopt);
  EXPECT_EQ(lines.admit(kBegin + 10s, 1), 10u);
  EXPECT_EQ(lines.admit(kBegin + 20s), 1u);
}

}  // namespace
}  // namespace dssm::daemon
