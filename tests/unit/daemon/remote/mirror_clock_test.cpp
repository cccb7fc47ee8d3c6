// SPDX-License-Identifier: Apache-2.0
#include "daemon/remote/mirror_clock.hpp"

#include <gtest/gtest.h>

#include "tests/unit/daemon/remote/fake_clock_rules.hpp"

namespace dssm::daemon {
namespace {

using namespace std::chrono_literals;

MirrorClock::Report report(Duration bound, std::uint8_t anchor = 1) {
  auto made = std::make_shared<wire::ClockReport>();
  made->standing.bound = bound;
  made->standing.anchor = {anchor};
  return made;
}

class MirrorClockTest : public testing::Test {
 protected:
  bool is_doubtful(Tid tid) const {
    const ring::ClockVerdict verdict = clock.verdict();
    return tid >= verdict.doubtful_first && tid <= verdict.doubtful_last;
  }

  const StreamId id{"lidar", 0, "pc2"};
  FakeClockRules rules;
  MirrorClock clock{&rules, id};
};

TEST_F(MirrorClockTest, WithoutRulesNobodyJudges) {
  const MirrorClock free(nullptr, id);
  EXPECT_EQ(free.verdict().rule, ring::ClockRule::none);
  EXPECT_TRUE(free.check_opening());
  EXPECT_EQ(free.trouble(), "");
}

TEST_F(MirrorClockTest, AStreamIsOpenedWhenSomethingIsAllowed) {
  clock.on_owner(report(1ms), kNoTid);
  EXPECT_TRUE(clock.check_opening());
  EXPECT_EQ(clock.trouble(), "");
  clock.on_owner(report(1ms + 1ns), kNoTid);
  const Result<void> refused = clock.check_opening();
  ASSERT_FALSE(refused);
  EXPECT_EQ(refused.error().code, Errc::clock_out_of_bounds);
  EXPECT_EQ(clock.trouble(), "not 'lidar:0@pc2'");
}

TEST_F(MirrorClockTest, AStreamIsOpenedUntilItsOwnerWasHeardOf) {
  EXPECT_FALSE(clock.is_heard());
  EXPECT_TRUE(clock.check_opening());
  clock.on_owner(nullptr, kNoTid);  // a dssmd that says nothing of its clock
  EXPECT_TRUE(clock.is_heard());
  EXPECT_FALSE(clock.check_opening());
}

TEST_F(MirrorClockTest, MarkedStreamsAreOpenedAndTold) {
  rules.rule = ring::ClockRule::mark;
  clock.on_owner(report(2ms), kNoTid);
  EXPECT_TRUE(clock.check_opening());
  EXPECT_EQ(clock.trouble(), "not 'lidar:0@pc2'");
}

TEST_F(MirrorClockTest, SamplesThatComeWhileTheOwnersClockIsUnknownStayDoubtful) {
  clock.on_owner(report(1us), 9);
  EXPECT_FALSE(is_doubtful(9));
  clock.on_owner(report(kUnknownClockError), 9);  // it was set
  EXPECT_FALSE(is_doubtful(9));
  EXPECT_TRUE(is_doubtful(10));
  clock.on_owner(report(kUnknownClockError), 15);
  EXPECT_TRUE(is_doubtful(10)) << "from the first one on";
  clock.on_owner(report(1us), 20);
  EXPECT_FALSE(is_doubtful(9));
  EXPECT_TRUE(is_doubtful(10));
  EXPECT_TRUE(is_doubtful(20));
  EXPECT_FALSE(is_doubtful(21));
}

TEST_F(MirrorClockTest, WhatWasDoubtfulOnceStaysSoWhenTheClockIsSetAgain) {
  clock.on_owner(report(1us), 9);
  for (const Tid newest : {10, 20}) {
    clock.on_owner(report(kUnknownClockError), newest);
    clock.on_owner(report(1us), newest + 5);
  }
  EXPECT_FALSE(is_doubtful(10));
  EXPECT_TRUE(is_doubtful(11));
  EXPECT_TRUE(is_doubtful(25));
  EXPECT_FALSE(is_doubtful(26));
}

TEST_F(MirrorClockTest, WhatWasStampedAgainstAnotherReferenceIsDoubtful) {
  clock.on_owner(report(1us, 1), 9);
  clock.on_owner(report(1us, 2), 12);
  EXPECT_TRUE(is_doubtful(0));
  EXPECT_TRUE(is_doubtful(12));
  EXPECT_FALSE(is_doubtful(13));
}

TEST_F(MirrorClockTest, ANewRingHasNoDoubtfulSamples) {
  clock.on_owner(report(1us, 1), 9);
  clock.on_owner(report(1us, 2), 12);
  clock.on_new_ring();
  EXPECT_FALSE(is_doubtful(0));
}

TEST_F(MirrorClockTest, ANewRingOfAnUnknownClockIsAllDoubtful) {
  clock.on_owner(report(kUnknownClockError), 9);
  clock.on_new_ring();
  EXPECT_TRUE(is_doubtful(0));
}

}  // namespace
}  // namespace dssm::daemon
