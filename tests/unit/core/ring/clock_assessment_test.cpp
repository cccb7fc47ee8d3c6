// SPDX-License-Identifier: Apache-2.0
//
// Which samples are good: by their clock errors, and by what was measured between the two clocks.
#include "core/ring/clock_assessment.hpp"

#include "core/ring/ring_reader.hpp"
#include "tests/unit/core/ring/test_ring.hpp"

namespace dssm::ring {
namespace {

using namespace std::chrono_literals;

constexpr MonoTime kAssessed(100s);

// Of a limit of 1500 us, 300 us are used up by the two clocks, which lose 100 us a second.
// Nothing is measured.
ClockAssessment enforced() {
  return {.policy = ClockPolicy::enforce,
          .same_clock = 0,
          .ageing_ppb = 100'000,
          .added = 300us,
          .limit = 1500us,
          .assessed = kAssessed};
}

SampleInfo sample(Duration clock_error, Tid tid = 7) { return {tid, Time(), clock_error}; }

TEST(ClockAssessment, ASampleIsAsFarAsItsErrorAndWhatIsAdded) {
  EXPECT_EQ(enforced().distance(sample(200us), kAssessed), 500us);
  EXPECT_EQ(enforced().distance(sample(200us), kAssessed + 2s), 700us) << "the clocks run on";
  EXPECT_EQ(enforced().distance(sample(kUnknownClockError), kAssessed), kUnknownClockError);
}

TEST(ClockAssessment, ASampleIsGoodUpToTheLimit) {
  EXPECT_TRUE(enforced().is_good(sample(1200us), kAssessed));
  EXPECT_FALSE(enforced().is_good(sample(1200us + 1ns), kAssessed));
  EXPECT_FALSE(enforced().is_good(sample(1200us), kAssessed + 1s));
  EXPECT_TRUE(enforced().is_good(sample(1100us), kAssessed + 1s));
  EXPECT_FALSE(enforced().is_good(sample(kUnknownClockError), kAssessed));
}

TEST(ClockAssessment, AnOldOneCountsAsUnknown) {
  const MonoTime last = kAssessed + ClockAssessment::kValidFor;
  EXPECT_TRUE(enforced().is_good(sample(0us), last));
  EXPECT_FALSE(enforced().is_good(sample(0us), last + 1ns));
  EXPECT_EQ(enforced().distance(sample(0us), last + 1ns), kUnknownClockError);
}

TEST(ClockAssessment, SuspectSamplesAreNotGood) {
  ClockAssessment clock = enforced();
  clock.suspect_first = 5;
  clock.suspect_last = 9;
  EXPECT_TRUE(clock.is_good(sample(0us, 4), kAssessed));
  EXPECT_FALSE(clock.is_good(sample(0us, 5), kAssessed));
  EXPECT_FALSE(clock.is_good(sample(0us, 9), kAssessed));
  EXPECT_TRUE(clock.is_good(sample(0us, 10), kAssessed));
  EXPECT_EQ(clock.distance(sample(0us, 5), kAssessed), kUnknownClockError);
}

// 80 us between the two clocks, for samples of the last minute.
ClockAssessment measured() {
  ClockAssessment clock = enforced();
  clock.measured = 80us;
  clock.measured_from = time_from_ns(1'000);
  clock.measured_ageing_ppb = 10'000;
  return clock;
}

SampleInfo sample_at(std::int64_t ns, Duration clock_error) {
  return {7, time_from_ns(ns), clock_error};
}

TEST(ClockAssessment, WhatIsMeasuredCountsWhereItIsLess) {
  EXPECT_EQ(measured().distance(sample_at(1'000, 200us), kAssessed), 80us);
  EXPECT_EQ(measured().distance(sample_at(1'000, 200us), kAssessed + 2s), 100us);
  EXPECT_EQ(measured().distance(sample_at(999, 200us), kAssessed), 500us) << "before it began";
  ClockAssessment clock = measured();
  clock.measured = 2ms;
  EXPECT_EQ(clock.distance(sample_at(1'000, 200us), kAssessed), 500us);
  EXPECT_TRUE(clock.is_good(sample_at(1'000, 200us), kAssessed));
}

TEST(ClockAssessment, SamplesOfTheLastSecondsCountByWhatWasMeasuredThen) {
  ClockAssessment clock = measured();
  clock.recent = 30us;
  clock.recent_from = time_from_ns(5'000);
  EXPECT_EQ(clock.distance(sample_at(4'999, 200us), kAssessed), 80us);
  EXPECT_EQ(clock.distance(sample_at(5'000, 200us), kAssessed), 30us);
  EXPECT_EQ(clock.distance(sample_at(5'000, 200us), kAssessed + 2s), 50us);
  clock.measured = clock.added = kUnknownClockError;
  EXPECT_TRUE(clock.can_be_good());
  EXPECT_TRUE(clock.is_good(sample_at(5'000, kUnknownClockError), kAssessed));
  EXPECT_FALSE(clock.is_good(sample_at(4'999, kUnknownClockError), kAssessed));
}

TEST(ClockAssessment, SamplesFromBeforeTheClockWasSetBackAreNotMeasured) {
  ClockAssessment clock = measured();
  clock.recent = 30us;
  clock.measured_first_tid = 7;
  EXPECT_EQ(clock.distance({7, time_from_ns(1'000), 200us}, kAssessed), 30us);
  EXPECT_EQ(clock.distance({6, time_from_ns(1'000), 200us}, kAssessed), 500us);
}

TEST(ClockAssessment, AMeasurementNeedsNoClockErrorAndNoTrustInIt) {
  EXPECT_TRUE(measured().is_good(sample_at(1'000, kUnknownClockError), kAssessed));
  EXPECT_FALSE(measured().is_good(sample_at(999, kUnknownClockError), kAssessed));
  ClockAssessment clock = measured();
  clock.suspect_first = 0;
  clock.suspect_last = 100;
  EXPECT_TRUE(clock.is_good(sample_at(1'000, 0us), kAssessed));
  clock.measured = 1501us;
  EXPECT_FALSE(clock.is_good(sample_at(1'000, 0us), kAssessed));
  const MonoTime last = kAssessed + ClockAssessment::kValidFor;
  EXPECT_FALSE(measured().is_good(sample_at(1'000, 0us), last + 1ns)) << "dssmd is away";
}

TEST(ClockAssessment, AnAgeingThatNoHonestDssmdStatesDoesNotOverflow) {
  ClockAssessment clock = measured();
  clock.measured_ageing_ppb = UINT32_MAX;
  EXPECT_EQ(clock.distance(sample_at(1'000, kUnknownClockError), kAssessed + 3s), 3s + 80us);
}

TEST(ClockAssessment, CanBeGoodByEitherOfBoth) {
  EXPECT_TRUE(enforced().can_be_good());
  ClockAssessment clock = measured();
  clock.added = kUnknownClockError;
  EXPECT_TRUE(clock.can_be_good());
  clock.measured = 1501us;
  EXPECT_FALSE(clock.can_be_good());
  clock.measured = kUnknownClockError;
  clock.limit = kUnknownClockError;
  EXPECT_FALSE(clock.can_be_good());
}

TEST(ClockAssessment, ARecordingsTimesAreGoodButWhileTheClockIsBeingSet) {
  ClockAssessment clock = enforced();
  clock.limit = 100us;
  EXPECT_TRUE(clock.is_good(sample(kForeignClockError), kAssessed + 1h));
  EXPECT_EQ(clock.distance(sample(kForeignClockError), kAssessed), kUnknownClockError);
  clock.suspect_first = 7;
  clock.suspect_last = 7;
  EXPECT_FALSE(clock.is_good(sample(kForeignClockError), kAssessed));
}

TEST(ClockAssessment, OneClockHasNoDistance) {
  ClockAssessment clock;
  EXPECT_EQ(clock.distance(sample(kUnknownClockError), kAssessed), 0us) << "an own stream";
  EXPECT_TRUE(clock.is_good(sample(kUnknownClockError), kAssessed));
  clock.policy = ClockPolicy::enforce;
  EXPECT_EQ(clock.distance(sample(kUnknownClockError), kAssessed), 0us);
  EXPECT_TRUE(clock.is_good(sample(kUnknownClockError), kAssessed));
}

TEST(ClockAssessment, WithoutAPolicyAllIsGoodAndTheDistanceStillKnown) {
  ClockAssessment clock = enforced();
  clock.policy = ClockPolicy::off;
  clock.limit = 100us;
  EXPECT_TRUE(clock.is_good(sample(kUnknownClockError), kAssessed));
  EXPECT_EQ(clock.distance(sample(100us), kAssessed), 400us);
}

TEST(ClockAssessment, OfAnUnknownClockNothingIsGoodUnlessThePolicyIsOff) {
  EXPECT_FALSE(
      ClockAssessment::unknown_clock(ClockPolicy::enforce).is_good(sample(0us), kAssessed));
  EXPECT_FALSE(ClockAssessment::unknown_clock(ClockPolicy::mark).is_good(sample(0us), kAssessed));
  const ClockAssessment off = ClockAssessment::unknown_clock(ClockPolicy::off);
  EXPECT_TRUE(off.is_good(sample(0us), kAssessed));
  EXPECT_EQ(off.distance(sample(0us), kAssessed), kUnknownClockError);
}

// The numbers of docs/ring-layout.md "Clock", by hand.
TEST(ClockAssessment, HasItsDocumentedOffsets) {
  EXPECT_EQ(offsetof(ClockAssessment, policy), 0u);
  EXPECT_EQ(offsetof(ClockAssessment, same_clock), 1u);
  EXPECT_EQ(offsetof(ClockAssessment, ageing_ppb), 4u);
  EXPECT_EQ(offsetof(ClockAssessment, added), 8u);
  EXPECT_EQ(offsetof(ClockAssessment, limit), 16u);
  EXPECT_EQ(offsetof(ClockAssessment, assessed), 24u);
  EXPECT_EQ(offsetof(ClockAssessment, suspect_first), 32u);
  EXPECT_EQ(offsetof(ClockAssessment, suspect_last), 40u);
  EXPECT_EQ(offsetof(ClockAssessment, measured), 48u);
  EXPECT_EQ(offsetof(ClockAssessment, measured_from), 56u);
  EXPECT_EQ(offsetof(ClockAssessment, measured_ageing_ppb), 64u);
  EXPECT_EQ(offsetof(ClockAssessment, recent), 72u);
  EXPECT_EQ(offsetof(ClockAssessment, recent_from), 80u);
  EXPECT_EQ(offsetof(ClockAssessment, measured_first_tid), 88u);
  EXPECT_EQ(sizeof(ClockAssessment), 96u);
}

TEST(ClockAssessment, IsEnforcedInARingOnlyForAnotherClockUnderThatPolicy) {
  const TestRing ring(8, 4);
  const RingReader reader(*ring.mapping);
  EXPECT_FALSE(reader.enforces_clock()) << "nothing was stored: only this PC writes to it";
  ClockAssessment stored = enforced();
  ring.mapping->header().clock.store(stored);
  EXPECT_TRUE(reader.enforces_clock());
  stored.same_clock = 1;
  ring.mapping->header().clock.store(stored);
  EXPECT_FALSE(reader.enforces_clock());
  stored.same_clock = 0;
  stored.policy = ClockPolicy::mark;
  ring.mapping->header().clock.store(stored);
  EXPECT_FALSE(reader.enforces_clock());
}

TEST(ClockAssessment, IsReadInARingAsItWasStored) {
  const TestRing ring(8, 4);
  const RingReader reader(*ring.mapping);
  EXPECT_TRUE(reader.clock().same_clock) << "nothing was stored: only this PC writes to it";
  ClockAssessment stored = enforced();
  stored.suspect_first = 3;
  stored.suspect_last = 4;
  ring.mapping->header().clock.store(stored);
  const ClockAssessment read = reader.clock();
  EXPECT_EQ(read.policy, ClockPolicy::enforce);
  EXPECT_FALSE(read.same_clock);
  EXPECT_EQ(read.added, 300us);
  EXPECT_EQ(read.limit, 1500us);
  EXPECT_EQ(read.ageing_ppb, 100'000U);
  EXPECT_EQ(read.assessed, kAssessed);
  EXPECT_EQ(read.suspect_first, 3);
  EXPECT_EQ(read.suspect_last, 4);
}

}  // namespace
}  // namespace dssm::ring
