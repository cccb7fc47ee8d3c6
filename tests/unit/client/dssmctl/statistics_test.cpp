// SPDX-License-Identifier: Apache-2.0
#include "client/dssmctl/statistics.hpp"

#include <gtest/gtest.h>

namespace dssm::ctl {
namespace {

TEST(Window, KnowsNothingWhenEmpty) {
  const Statistics statistics = Window(3).statistics();
  EXPECT_EQ(statistics.count, 0U);
  EXPECT_EQ(statistics.mean_ns, 0);
}

TEST(Window, ComputesMeanExtremesAndDeviationOfThePopulation) {
  Window window(10);
  for (const int ns : {2, 4, 4, 4, 5, 5, 7, 9}) window.add(Duration(ns));
  const Statistics statistics = window.statistics();
  EXPECT_EQ(statistics.count, 8U);
  EXPECT_EQ(statistics.mean_ns, 5);
  EXPECT_EQ(statistics.std_dev_ns, 2);
  EXPECT_EQ(statistics.min, Duration(2));
  EXPECT_EQ(statistics.max, Duration(9));
}

TEST(Window, KeepsTheNewestValuesOnly) {
  Window window(2);
  for (const int ns : {1000, 1, 3}) window.add(Duration(ns));
  EXPECT_EQ(window.statistics().mean_ns, 2);
  EXPECT_EQ(window.statistics().max, Duration(3));
}

TEST(Window, DoesNotOverflowOnTheLongestDurations) {
  Window window(4);
  for (int i = 0; i < 4; ++i) window.add(Duration::max());
  EXPECT_DOUBLE_EQ(window.statistics().mean_ns, static_cast<double>(Duration::max().count()));
}

TEST(Window, TakesDurationsBelowZero) {
  Window window(4);
  window.add(Duration(-10));
  window.add(Duration(20));
  EXPECT_EQ(window.statistics().mean_ns, 5);
  EXPECT_EQ(window.statistics().min, Duration(-10));
}

}  // namespace
}  // namespace dssm::ctl
