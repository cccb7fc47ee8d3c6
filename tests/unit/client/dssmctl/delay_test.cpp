// SPDX-License-Identifier: Apache-2.0
#include "client/dssmctl/delay.hpp"

#include <gtest/gtest.h>

namespace dssm::ctl {
namespace {

using namespace std::chrono_literals;

HostInfo host(std::string name, HostState state, Duration clock_bound) {
  HostInfo info;
  info.name = std::move(name);
  info.state = state;
  info.clock.emplace().bound = clock_bound;
  return info;
}

SampleInfo sample(Duration clock_error) { return {0, Time{}, clock_error}; }

TEST(Clocks, MakeNoErrorWhenThereIsOne) {
  Clocks clocks(10);
  EXPECT_FALSE(clocks.are_two());
  clocks.update({host("pc1", HostState::self, kUnknownClockError)}, "pc1");
  clocks.add(sample(5ms));
  EXPECT_FALSE(clocks.are_two());
  EXPECT_EQ(clocks.delay_error(), 0ns);
}

TEST(Clocks, AddUpStampsAndOwnBound) {
  Clocks clocks(2);
  clocks.update({host("pc1", HostState::self, 1ms), host("pc2", HostState::up, 40ms)}, "pc2");
  for (const Duration error : {9ms, 2ms, 3ms}) clocks.add(sample(error));
  EXPECT_TRUE(clocks.are_two());
  EXPECT_EQ(clocks.delay_error(), 4ms);  // the 9 ms have left the window
}

TEST(Clocks, TakeTheOwnersBoundForStampsWithoutOne) {
  Clocks clocks(10);
  clocks.update({host("pc1", HostState::self, 1ms), host("pc3", HostState::up, 1s),
                 host("pc2", HostState::up, 40ms)},
                "pc2");
  clocks.add(sample(2ms));
  clocks.add(sample(kUnknownClockError));
  EXPECT_EQ(clocks.delay_error(), 41ms);
}

TEST(Clocks, AreUnknownWhenOneOfThemIs) {
  Clocks clocks(10);
  clocks.add(sample(2ms));
  clocks.update({host("pc1", HostState::self, kUnknownClockError), host("pc2", HostState::up, 1ms)},
                "pc2");
  EXPECT_EQ(clocks.delay_error(), kUnknownClockError);
  clocks.add(sample(kUnknownClockError));
  clocks.update({host("pc1", HostState::self, 1ms), host("pc2", HostState::down, 1ms)}, "pc2");
  EXPECT_EQ(clocks.delay_error(), kUnknownClockError);
}

}  // namespace
}  // namespace dssm::ctl
