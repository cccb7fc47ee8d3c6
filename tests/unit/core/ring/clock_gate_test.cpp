// SPDX-License-Identifier: Apache-2.0
#include "core/ring/clock_gate.hpp"

#include <gtest/gtest.h>

namespace dssm::ring {
namespace {

using namespace std::chrono_literals;

constexpr MonoTime kJudged(100s);

// Of a limit of 1500 us, 300 us are used up by the two clocks, which lose 100 us a second.
ClockVerdict enforced() {
  return {.rule = ClockRule::enforce,
          .added = 300us,
          .allowed = 1200us,
          .ageing_ppb = 100'000,
          .judged = kJudged,
          .doubtful_first = 0,
          .doubtful_last = kNoTid};
}

SampleInfo sample(Duration clock_error, Tid tid = 7) { return {tid, Time(), clock_error}; }

TEST(ClockGate, ASampleIsAsFarAsItsErrorAndWhatIsAdded) {
  EXPECT_EQ(enforced().distance(sample(200us), kJudged), 500us);
  EXPECT_EQ(enforced().distance(sample(200us), kJudged + 2s), 700us) << "the clocks run on";
  EXPECT_EQ(enforced().distance(sample(kUnknownClockError), kJudged), kUnknownClockError);
}

TEST(ClockGate, ASampleIsGoodUpToTheLimit) {
  EXPECT_TRUE(enforced().is_good(sample(1200us), kJudged));
  EXPECT_FALSE(enforced().is_good(sample(1200us + 1ns), kJudged));
  EXPECT_FALSE(enforced().is_good(sample(1200us), kJudged + 1s));
  EXPECT_TRUE(enforced().is_good(sample(1100us), kJudged + 1s));
  EXPECT_FALSE(enforced().is_good(sample(kUnknownClockError), kJudged));
}

TEST(ClockGate, AnOldVerdictIsNone) {
  const MonoTime last = kJudged + ClockVerdict::kHolds;
  EXPECT_TRUE(enforced().is_good(sample(0us), last));
  EXPECT_FALSE(enforced().is_good(sample(0us), last + 1ns));
  EXPECT_EQ(enforced().distance(sample(0us), last + 1ns), kUnknownClockError);
}

TEST(ClockGate, NothingIsGoodWhenNothingIsAllowed) {
  ClockVerdict verdict = enforced();
  verdict.allowed = Duration(-1);
  EXPECT_FALSE(verdict.is_good(sample(0us), kJudged));
}

TEST(ClockGate, DoubtfulSamplesAreNotGood) {
  ClockVerdict verdict = enforced();
  verdict.doubtful_first = 5;
  verdict.doubtful_last = 9;
  EXPECT_TRUE(verdict.is_good(sample(0us, 4), kJudged));
  EXPECT_FALSE(verdict.is_good(sample(0us, 5), kJudged));
  EXPECT_FALSE(verdict.is_good(sample(0us, 9), kJudged));
  EXPECT_TRUE(verdict.is_good(sample(0us, 10), kJudged));
  EXPECT_EQ(verdict.distance(sample(0us, 5), kJudged), kUnknownClockError);
}

TEST(ClockGate, NobodyJudgesARecordingsTimesButWhileTheClockIsBeingSet) {
  ClockVerdict verdict = enforced();
  verdict.allowed = Duration(-1);
  EXPECT_TRUE(verdict.is_good(sample(kForeignClockError), kJudged + 1h));
  EXPECT_EQ(verdict.distance(sample(kForeignClockError), kJudged), kUnknownClockError);
  verdict.doubtful_first = 7;
  verdict.doubtful_last = 7;
  EXPECT_FALSE(verdict.is_good(sample(kForeignClockError), kJudged));
}

TEST(ClockGate, OneClockHasNoDistance) {
  ClockVerdict verdict;
  EXPECT_EQ(verdict.distance(sample(kUnknownClockError), kJudged), 0us) << "an own stream";
  EXPECT_TRUE(verdict.is_good(sample(kUnknownClockError), kJudged));
  verdict.rule = ClockRule::same_clock;
  EXPECT_EQ(verdict.distance(sample(kUnknownClockError), kJudged), 0us);
  EXPECT_TRUE(verdict.is_good(sample(kUnknownClockError), kJudged));
}

TEST(ClockGate, WhereNobodyLooksAllIsGoodAndTheDistanceStillKnown) {
  ClockVerdict verdict = enforced();
  verdict.rule = ClockRule::off;
  verdict.allowed = Duration(-1);
  EXPECT_TRUE(verdict.is_good(sample(kUnknownClockError), kJudged));
  EXPECT_EQ(verdict.distance(sample(100us), kJudged), 400us);
}

TEST(ClockGate, IsReadAsItWasWritten) {
  ClockGate gate{};
  EXPECT_EQ(load(gate).rule, ClockRule::none) << "all zero";
  store(gate, enforced());
  const ClockVerdict read = load(gate);
  EXPECT_EQ(read.rule, ClockRule::enforce);
  EXPECT_EQ(read.added, 300us);
  EXPECT_EQ(read.allowed, 1200us);
  EXPECT_EQ(read.ageing_ppb, 100'000U);
  EXPECT_EQ(read.judged, kJudged);
  EXPECT_EQ(read.doubtful_first, 0);
  EXPECT_EQ(read.doubtful_last, kNoTid);
}

TEST(ClockGate, OneThatItsDssmdLeftHalfWrittenLetsNothingThrough) {
  ClockGate gate{};
  store(gate, enforced());
  gate.sequence.fetch_add(1);
  EXPECT_FALSE(load(gate).is_good(sample(0us), kJudged));
  store(gate, enforced());  // the next dssmd
  EXPECT_TRUE(load(gate).is_good(sample(0us), kJudged));
}

}  // namespace
}  // namespace dssm::ring
