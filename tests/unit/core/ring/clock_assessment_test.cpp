// SPDX-License-Identifier: Apache-2.0
#include "core/ring/clock_assessment.hpp"

#include "core/ring/ring_reader.hpp"
#include "tests/unit/core/ring/test_ring.hpp"

namespace dssm::ring {
namespace {

using namespace std::chrono_literals;

constexpr MonoTime kAssessed(100s);

// Of a limit of 1500 us, 300 us are used up by the two clocks, which lose 100 us a second.
ClockAssessment enforced() {
  return {.policy = ClockPolicy::enforce,
          .same_clock = 0,
          .ageing_ppb = 100'000,
          .added = 300us,
          .limit = 1200us,
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

TEST(ClockAssessment, NothingIsGoodBelowALimitOfZero) {
  ClockAssessment clock = enforced();
  clock.limit = Duration(-1);
  EXPECT_FALSE(clock.is_good(sample(0us), kAssessed));
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

TEST(ClockAssessment, ARecordingsTimesAreGoodButWhileTheClockIsBeingSet) {
  ClockAssessment clock = enforced();
  clock.limit = Duration(-1);
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
  clock.limit = Duration(-1);
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
  EXPECT_EQ(sizeof(ClockAssessment), 48u);
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
  EXPECT_EQ(read.limit, 1200us);
  EXPECT_EQ(read.ageing_ppb, 100'000U);
  EXPECT_EQ(read.assessed, kAssessed);
  EXPECT_EQ(read.suspect_first, 3);
  EXPECT_EQ(read.suspect_last, 4);
}

}  // namespace
}  // namespace dssm::ring
