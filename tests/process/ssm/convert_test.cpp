// SPDX-License-Identifier: Apache-2.0
//
// Between SSM's doubles and ints and the ring's 64-bit numbers.
#include "client/ssm/src/convert.hpp"

#include <gtest/gtest.h>

#include <cmath>
#include <limits>
#include <random>

#include "client/ssm/src/socket_path.hpp"

namespace dssm::ssm {
namespace {

TEST(SsmTime, ComesBackExactlyForPresentDayTimes) {
  const std::random_device::result_type seed = std::random_device()();
  SCOPED_TRACE(testing::Message() << "seed " << seed);
  std::mt19937_64 random(seed);
  std::uniform_real_distribution<double> time(1.0e9, 4.0e9);  // 2001 to 2096
  for (int i = 0; i < 1'000'000; ++i) {
    const double t = time(random);
    ASSERT_EQ(seconds_from_ns(ns_from_seconds(t)), t);
    ASSERT_EQ(seconds_from_ns(ns_from_seconds(-t)), -t);
  }
}

TEST(SsmTime, KeepsDecimalsOfNanoseconds) {
  const std::random_device::result_type seed = std::random_device()();
  SCOPED_TRACE(testing::Message() << "seed " << seed);
  std::mt19937_64 random(seed);
  std::uniform_int_distribution<std::int64_t> ns(-8'388'608'000'000'000, 8'388'608'000'000'000);
  for (int i = 0; i < 1'000'000; ++i) {  // up to 2^23 s: a double holds single nanoseconds
    const std::int64_t n = i < 1000 ? i : ns(random);
    ASSERT_EQ(ns_from_seconds(seconds_from_ns(n)), n);
  }
  EXPECT_EQ(ns_from_seconds(0.1), 100'000'000);
  EXPECT_EQ(seconds_from_ns(100'000'000), 0.1);
  EXPECT_EQ(ns_from_seconds(1e-9), 1);
  EXPECT_EQ(ns_from_seconds(0.4e-9), 0);
  EXPECT_EQ(ns_from_seconds(-1e-20), 0);
  EXPECT_EQ(ns_from_seconds(-0.25), -250'000'000);
}

TEST(SsmTime, KeepsOrder) {
  double before = 1.7e9;
  for (int i = 0; i < 100'000; ++i) {
    const double after = std::nextafter(before, 4e9);
    ASSERT_LT(ns_from_seconds(before), ns_from_seconds(after));
    before = after;
  }
}

TEST(SsmTime, SaturatesBeyond64BitsAndTakesNanAsZero) {
  constexpr std::int64_t kMax = std::numeric_limits<std::int64_t>::max();
  constexpr std::int64_t kMin = std::numeric_limits<std::int64_t>::min();
  for (const double t : {1e10, 1e300, std::numeric_limits<double>::infinity(), 9223372036.0}) {
    EXPECT_EQ(ns_from_seconds(t), kMax);
    EXPECT_EQ(ns_from_seconds(-t), kMin);
  }
  EXPECT_EQ(ns_from_seconds(std::nextafter(9223372036.0, 0)), 9223372035999998093);
  EXPECT_EQ(ns_from_seconds(std::numeric_limits<double>::quiet_NaN()), 0);
}

TEST(SsmTid, IsTheRingsOwnWhileTheStreamIsYoung) {
  for (const Tid newest : {Tid{-1}, Tid{0}, Tid{5}, kTidMask}) {
    for (const int tid : {0, 4, 1'000'000'000, 2'147'483'647}) {
      EXPECT_EQ(ring_tid(tid, newest), tid);
    }
  }
  EXPECT_EQ(ssm_tid(-1), -1);
  EXPECT_EQ(ssm_tid(0), 0);
  EXPECT_EQ(ssm_tid(kTidMask), 2'147'483'647);
}

TEST(SsmTid, ContinuesAtZeroAfter31BitsAndMeansTheClosestSample) {
  const Tid wrap = kTidMask + 1;
  EXPECT_EQ(ssm_tid(wrap), 0);
  EXPECT_EQ(ssm_tid(5 * wrap + 7), 7);
  const Tid newest = 3 * wrap + 10;
  EXPECT_EQ(ring_tid(10, newest), newest);
  EXPECT_EQ(ring_tid(9, newest), newest - 1);
  EXPECT_EQ(ring_tid(2'147'483'647, newest), 3 * wrap - 1);  // before the turn
  EXPECT_EQ(ring_tid(12, newest), newest + 2);               // not written yet
  EXPECT_EQ(ring_tid(1, 3 * wrap - 1), 3 * wrap + 1);
}

TEST(SsmSocketPath, IsTheVariableElseThePcsElseTheUsers) {
  ::setenv("DSSM_SOCKET", "/somewhere/dssmd.sock", 1);
  EXPECT_EQ(socket_paths(), std::vector<std::string>{"/somewhere/dssmd.sock"});
  ::unsetenv("DSSM_SOCKET");
  ::setenv("XDG_RUNTIME_DIR", "/run/user/1000", 1);
  EXPECT_EQ(socket_paths(),
            (std::vector<std::string>{"/run/dssm/dssmd.sock", "/run/user/1000/dssm/dssmd.sock"}));
  ::unsetenv("XDG_RUNTIME_DIR");
  EXPECT_EQ(socket_paths(), std::vector<std::string>{"/run/dssm/dssmd.sock"});
}

}  // namespace
}  // namespace dssm::ssm
