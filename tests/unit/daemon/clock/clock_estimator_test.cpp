// SPDX-License-Identifier: Apache-2.0
//
// The clock estimator on simulated clocks: which bound follows from chronyd's answers and from
// steps, and when there is none.
#include "daemon/clock/clock_estimator.hpp"

#include <gtest/gtest.h>

namespace dssm::clock {
namespace {

using namespace std::chrono_literals;
using Outcome = ClockEstimator::Outcome;

constexpr std::uint32_t kPc1 = 0x0a000001;
constexpr PartsPerBillion kAgeing = 56'250;  // 50 ppm of a slewed second

// An estimator whose clock and chronyd the test moves by hand.
struct Rig {
  ClockEstimator estimator{ClockEstimator::Settings{}};
  Instant now{MonoTime(1000s), Time(2'000'000s), {}};
  Tracking tracking = synchronized();

  static Tracking synchronized() {
    Tracking t;
    t.reference_id = kPc1;
    t.stratum = 11;
    t.leap = 0;
    t.update_interval = 1s;
    t.offset = 10us;
    t.root = {20us, 60us};
    return t;
  }

  Rig() { estimator.observe(now); }

  void pass(Duration time) {
    now.mono += time;
    now.wall += time;
    now.raw += time;
    estimator.observe(now);
  }
  void step(Duration by) {
    now.wall += by;
    EXPECT_EQ(estimator.observe(now), by);
  }
  // chronyd answers at once, and learned something `age` ago.
  Outcome hear(Duration age = 0s) {
    tracking.updated = now.wall - tracking.offset - age;
    return estimator.take_untrusted(tracking, now.mono, now);
  }
  // chronyd has learned nothing since.
  Outcome hear_the_same() { return estimator.take_untrusted(tracking, now.mono, now); }
  ClockSnapshot state() const { return estimator.at(now.mono); }
};

// What is expected of a clock without a bound.
void expect_void(const ClockSnapshot& state, ClockReason why) {
  EXPECT_EQ(state.status, ClockStatus::out_of_bounds);
  EXPECT_EQ(state.reason, why);
  EXPECT_EQ(state.bound, kUnknownClockError);
  EXPECT_EQ(state.basis, ClockBasis::nothing);
}

TEST(ClockEstimator, KnowsNothingBeforeChronydAnswers) {
  Rig rig;
  EXPECT_EQ(rig.state(), ClockSnapshot());
  rig.estimator.on_no_chronyd();
  rig.pass(1h);
  EXPECT_EQ(rig.state(), ClockSnapshot());
}

TEST(ClockEstimator, StatesTheDistanceFromTheRoot) {
  Rig rig;
  EXPECT_EQ(rig.hear(), Outcome::taken);
  const ClockSnapshot state = rig.state();
  EXPECT_EQ(state.status, ClockStatus::synchronized);
  EXPECT_EQ(state.reason, ClockReason::none);
  EXPECT_EQ(state.basis, ClockBasis::root);
  EXPECT_EQ(state.bound, 60us);
  EXPECT_EQ(state.ageing_ppb, kAgeing);
  EXPECT_EQ(rig.estimator.reference_id(), kPc1);
  EXPECT_EQ(state.stratum, 11);
  EXPECT_EQ(state.offset, 10us);
}

TEST(ClockEstimator, AgesFromTheTimeWhenChronydLearnedSomething) {
  Rig rig;
  rig.hear(2s);
  EXPECT_EQ(rig.state().bound, 60us + growth(2s, kAgeing));
  rig.pass(1s);
  EXPECT_EQ(rig.state().bound, 60us + growth(3s, kAgeing));
}

TEST(ClockEstimator, AgesFromTheQuestionWhenTheAnswerTookTime) {
  Rig rig;
  const MonoTime asked = rig.now.mono;
  rig.pass(500ms);
  rig.tracking.updated = rig.now.wall - rig.tracking.offset;
  rig.estimator.take_untrusted(rig.tracking, asked, rig.now);
  EXPECT_EQ(rig.state().bound, 60us + growth(500ms, kAgeing));
}

TEST(ClockEstimator, AddsWhatItCannotDistinguishFromAStep) {
  Rig rig;
  rig.hear();
  rig.now.wall += 600ns;
  rig.now.width = 300ns;
  EXPECT_FALSE(rig.estimator.observe(rig.now));
  EXPECT_EQ(rig.state().bound, 60us + 900ns);
}

TEST(ClockEstimator, NoticesManySmallSteps) {
  Rig rig;
  rig.hear();
  rig.now.wall += 700ns;
  EXPECT_FALSE(rig.estimator.observe(rig.now));
  rig.now.wall += 700ns;
  EXPECT_EQ(rig.estimator.observe(rig.now), 1400ns);
}

TEST(ClockEstimator, FallsIntoHoldoverWhenChronydLearnsNothing) {
  Rig rig;
  rig.hear();
  rig.pass(5s);
  rig.hear(5s);
  EXPECT_EQ(rig.state().status, ClockStatus::synchronized);
  rig.pass(1s);
  rig.hear(6s);
  EXPECT_EQ(rig.state().status, ClockStatus::holdover);
  EXPECT_EQ(rig.state().bound, 60us + growth(6s, kAgeing));
  for (int age = 7; age < 30; ++age) {
    rig.pass(1s);
    rig.hear(std::chrono::seconds(age));
  }
  EXPECT_EQ(rig.state().status, ClockStatus::out_of_bounds);
  EXPECT_EQ(rig.state().reason, ClockReason::too_far);
  EXPECT_EQ(rig.state().bound, 60us + growth(29s, kAgeing)) << "still true";
}

TEST(ClockEstimator, HasNoBoundWhenChronydDoesNotAnswer) {
  Rig rig;
  rig.hear();
  rig.pass(ClockEstimator::kSilentAfter);
  EXPECT_EQ(rig.state().status, ClockStatus::synchronized);
  rig.pass(1ns);
  expect_void(rig.state(), ClockReason::silent);
  rig.hear();
  EXPECT_EQ(rig.state().status, ClockStatus::synchronized);
}

TEST(ClockEstimator, HasNoBoundAtOnceWhenThereIsNoChronyd) {
  Rig rig;
  rig.hear();
  rig.estimator.on_no_chronyd();
  expect_void(rig.state(), ClockReason::no_chronyd);
  rig.pass(1h);
  expect_void(rig.state(), ClockReason::no_chronyd);
}

TEST(ClockEstimator, HasNoBoundWhenChronydIsUnsynchronized) {
  Rig rig;
  rig.hear();
  rig.tracking = Tracking();
  rig.tracking.root = {1s, 1s};
  EXPECT_EQ(rig.estimator.take_untrusted(rig.tracking, rig.now.mono, rig.now),
            Outcome::unsynchronized);
  expect_void(rig.state(), ClockReason::unsynchronized);
}

TEST(ClockEstimator, TakesAnnouncedLeapSecondsForNormal) {
  for (const std::uint16_t leap : {std::uint16_t{1}, std::uint16_t{2}}) {
    Rig rig;
    rig.tracking.leap = leap;
    EXPECT_EQ(rig.hear(), Outcome::taken);
  }
}

TEST(ClockEstimator, HasNoBoundAfterAStepUntilChronydMeasuredAgain) {
  for (const Duration by : {Duration(200ms), Duration(-200ms), Duration(1h), Duration(-1h)}) {
    Rig rig;
    rig.hear();
    rig.step(by);
    expect_void(rig.state(), ClockReason::stepped);
    for (int i = 0; i < 10; ++i) {
      rig.pass(1s);
      EXPECT_EQ(rig.hear_the_same(), Outcome::stepped) << "chronyd did not notice";
      expect_void(rig.state(), ClockReason::stepped);
    }
    for (int i = 1; i < ClockEstimator::kUpdatesAfterStep; ++i) {
      rig.pass(1s);
      EXPECT_EQ(rig.hear(), Outcome::stepped);
      EXPECT_EQ(rig.hear_the_same(), Outcome::stepped) << "the same measurement counts once";
    }
    rig.pass(1s);
    EXPECT_EQ(rig.hear(), Outcome::taken);
    EXPECT_EQ(rig.state().bound, 60us);
  }
}

// chronyd states its last measurement by its own time, which goes along when it slews.
TEST(ClockEstimator, ASlewIsNoMeasurement) {
  Rig rig;
  rig.hear();
  rig.step(200ms);
  Duration age = 0s;
  for (int i = 0; i < 100; ++i) {
    rig.pass(100ms);
    rig.tracking.offset -= 5ms;
    EXPECT_EQ(rig.hear(age += 100ms), Outcome::stepped);
  }
}

TEST(ClockEstimator, HasNoBoundAfterAStepOfTheSourceUntilChronydMeasuredAgain) {
  Rig rig;
  rig.hear();
  rig.estimator.on_source_step();
  expect_void(rig.state(), ClockReason::stepped);
  for (int i = 1; i < ClockEstimator::kUpdatesAfterStep; ++i) {
    rig.pass(1s);
    EXPECT_EQ(rig.hear(), Outcome::stepped);
  }
  rig.pass(1s);
  EXPECT_EQ(rig.hear(), Outcome::taken);
  EXPECT_EQ(rig.estimator.setting(), to_ns(MonoTime(1000s).time_since_epoch())) << "not this clock";
}

TEST(ClockEstimator, TimesAreOfTheSettingFromTheLaterOfBothClocksOn) {
  Rig rig;
  EXPECT_EQ(rig.estimator.setting_from(), Time());
  const std::int64_t first = rig.estimator.setting();
  rig.pass(1s);
  rig.step(1h);
  EXPECT_NE(rig.estimator.setting(), first);
  EXPECT_EQ(rig.estimator.setting_from(), rig.now.wall);
  rig.pass(1s);
  const Time before = rig.now.wall;
  rig.step(-1h);
  EXPECT_EQ(rig.estimator.setting_from(), before);
}

TEST(ClockEstimator, CountsFromZeroWhenTheClockIsSteppedAgain) {
  Rig rig;
  rig.hear();
  rig.step(200ms);
  rig.pass(1s);
  rig.hear();
  rig.pass(1s);
  rig.hear();
  rig.step(-200ms);
  rig.pass(1s);
  EXPECT_EQ(rig.hear(), Outcome::stepped);
}

TEST(ClockEstimator, TakesALocalReferenceForRight) {
  Rig rig;
  rig.tracking.reference_id = kLocalReferenceId;
  rig.tracking.offset = 0s;
  rig.tracking.root = {};
  EXPECT_EQ(rig.hear(1s), Outcome::taken);
  rig.pass(3s);
  EXPECT_EQ(rig.state().status, ClockStatus::synchronized);
  EXPECT_EQ(rig.state().basis, ClockBasis::own);
  EXPECT_EQ(rig.state().bound, 0ns);
  EXPECT_EQ(rig.state().ageing_ppb, 0);
}

TEST(ClockEstimator, KnowsThatALocalReferenceIsStillBeingSlewed) {
  Rig rig;
  rig.tracking.reference_id = kLocalReferenceId;
  rig.tracking.offset = -40us;
  rig.hear();
  EXPECT_EQ(rig.state().bound, 40us);
}

TEST(ClockEstimator, HoldsOverWithoutReportsOfTheReferencePc) {
  Rig rig;
  rig.hear();
  rig.estimator.on_reference(ReferenceReport{kPc1, {}}, rig.now.mono);
  rig.pass(8s);
  rig.tracking.reference_id = kLocalReferenceId;
  rig.tracking.root = {};
  rig.hear();
  EXPECT_EQ(rig.state().status, ClockStatus::holdover);
  EXPECT_EQ(rig.state().bound, 60us + growth(8s, kAgeing));
}

TEST(ClockEstimator, IsNotRightByDefinitionWhenAnotherPcIs) {
  Rig rig;
  rig.tracking.reference_id = kLocalReferenceId;
  rig.hear();
  rig.estimator.on_reference(ReferenceReport{kPc1, {}}, rig.now.mono);
  rig.pass(1s);
  EXPECT_EQ(rig.hear(), Outcome::unsynchronized);
  expect_void(rig.state(), ClockReason::unsynchronized);
}

// Reports of the reference PC, and of chronyd's, one a second.
void hear_with_reference(Rig& rig, const ReferenceReport& report, int seconds) {
  for (int i = 0; i < seconds; ++i) {
    rig.pass(1s);
    rig.estimator.on_reference(report, rig.now.mono);
    rig.hear();
  }
}

TEST(ClockEstimator, StatesTheDistanceFromTheReferencePcOnceThatIsKnownLongEnough) {
  Rig rig;
  rig.tracking.root = {520us, 1060us};
  hear_with_reference(rig, {kPc1, {500us, 1000us}}, 256);
  EXPECT_EQ(rig.state().basis, ClockBasis::root);
  EXPECT_EQ(rig.state().bound, 10us + 520us + 530us);
  hear_with_reference(rig, {kPc1, {500us, 1000us}}, 1);
  EXPECT_EQ(rig.state().basis, ClockBasis::reference);
  EXPECT_EQ(rig.state().bound, 10us + 20us + 30us);
  rig.estimator.on_reference({}, rig.now.mono);
  EXPECT_EQ(rig.state().basis, ClockBasis::root);
}

// What chronyd says here may go back to a measurement 256 intervals ago.
TEST(ClockEstimator, UsesTheLeastReportOfTheReferencePcInTheTimeThatCounts) {
  Rig rig;
  rig.tracking.root = {520us, 1060us};
  hear_with_reference(rig, {kPc1, {500us, 1000us}}, 300);
  hear_with_reference(rig, {kPc1, {900us, 5000us}}, 200);
  EXPECT_EQ(rig.state().bound, 60us);
  hear_with_reference(rig, {kPc1, {400us, 5000us}}, 1);
  EXPECT_EQ(rig.state().bound, 160us);
  hear_with_reference(rig, {kPc1, {500us, 1000us}}, 256);
  EXPECT_EQ(rig.state().bound, 160us);
  hear_with_reference(rig, {kPc1, {500us, 1000us}}, 512);
  EXPECT_EQ(rig.state().bound, 60us);
}

TEST(ClockEstimator, StatesTheDistanceFromTheRootWhenItFollowsAnotherSource) {
  Rig rig;
  rig.tracking.root = {520us, 1060us};
  hear_with_reference(rig, {kPc1, {500us, 1000us}}, 300);
  rig.tracking.reference_id = 0x0a000002;
  rig.hear();
  EXPECT_EQ(rig.state().basis, ClockBasis::root);
  EXPECT_EQ(rig.state().bound, 1060us);
}

// --- corrections: others follow the time that chronyd here keeps

// chronyd measures that its time is wrong.
void correct(Rig& rig, Duration by) { rig.tracking.offset -= by; }

TEST(ClockEstimator, SumsUpTheCorrectionsOfChronydsTime) {
  Rig rig;
  rig.hear();
  correct(rig, 2200us);
  rig.pass(1s);
  rig.hear();
  EXPECT_EQ(rig.estimator.corrected(), 2200us);
  correct(rig, -300us);
  rig.pass(1s);
  rig.hear();
  EXPECT_EQ(rig.estimator.corrected(), 2500us) << "the sum of the sizes";
}

TEST(ClockEstimator, ASlewIsNoCorrection) {
  Rig rig;
  rig.tracking.offset = -2200us;
  rig.hear();
  rig.pass(1s);
  rig.now.wall += 2200us;  // both clocks are slewed alike
  rig.now.mono += 2200us;
  rig.tracking.offset = 0us;
  rig.hear();
  EXPECT_EQ(rig.estimator.corrected(), 0us);
}

TEST(ClockEstimator, NeitherTheRateThatChronydStatesNorDriftIsACorrection) {
  Rig rig;
  rig.tracking.rate_ppb = 400'000;
  rig.hear();
  for (const Duration drift : {49us, -49us, 149us}) {
    rig.pass(1s);
    rig.now.wall += 400us + drift;
    rig.now.mono += 400us + drift;
    rig.hear();
    EXPECT_EQ(rig.estimator.corrected(), 0us) << "kMinCorrection and a drift of 50 ppm";
  }
  rig.pass(1s);
  rig.hear();
  EXPECT_EQ(rig.estimator.corrected(), 400us);
}

TEST(ClockEstimator, AStepIsNoCorrectionButWhatItMakesChronydCorrectIsOne) {
  Rig rig;
  rig.hear();
  rig.pass(1ms);
  rig.step(5ms);
  for (int i = 0; i < 8; ++i) {
    rig.pass(1s);
    rig.hear();
    EXPECT_EQ(rig.estimator.corrected(), 0us) << "others hear of the step itself";
  }
  correct(rig, -5ms);  // it measures late that the clock was set
  rig.pass(1s);
  rig.hear();
  EXPECT_EQ(rig.estimator.corrected(), 5ms);
}

TEST(ClockEstimator, AnAnswerFromBeforeAStepSaysNothingOfCorrections) {
  Rig rig;
  rig.tracking.offset = -5ms;
  rig.hear();
  const MonoTime asked = rig.now.mono;
  rig.pass(1ms);
  rig.step(5ms);  // by chronyd, so that its time stays
  rig.estimator.take_untrusted(rig.tracking, asked, rig.now);
  rig.tracking.offset = 0us;
  rig.pass(1s);
  rig.hear();
  EXPECT_EQ(rig.estimator.corrected(), 0us);
}

TEST(ClockEstimator, ALateAnswerDuringASlewIsNoCorrection) {
  Rig rig;
  rig.tracking.offset = -1ms;
  rig.hear();
  rig.pass(1s);
  const MonoTime asked = rig.now.mono;
  rig.tracking.updated = rig.now.wall - rig.tracking.offset;
  rig.now.mono += 10ms + 900us;
  rig.now.wall += 10ms + 900us;
  rig.now.raw += 10ms;
  EXPECT_EQ(rig.estimator.take_untrusted(rig.tracking, asked, rig.now), Outcome::taken);
  EXPECT_EQ(rig.estimator.corrected(), 0us);
}

TEST(ClockEstimator, ACorrectionOfTheSourceCountsUntilChronydHasMeasuredThatAgain) {
  Rig rig;
  rig.hear();
  rig.estimator.on_source_correction(2200us);
  rig.estimator.on_source_correction(100us);
  EXPECT_EQ(rig.state().bound, 60us + 2300us);
  EXPECT_EQ(rig.state().reason, ClockReason::too_far);
  EXPECT_EQ(rig.state().root_bound, 60us) << "it was as near to the root as it stated";
  for (int i = 1; i < ClockEstimator::kUpdatesAfterStep; ++i) {
    rig.pass(1s);
    rig.hear();
    EXPECT_EQ(rig.state().bound, 60us + 2300us) << i;
  }
  rig.hear_the_same();
  EXPECT_EQ(rig.state().bound, 60us + 2300us) << "nothing new was measured";
  rig.pass(1s);
  rig.hear();
  EXPECT_EQ(rig.state().bound, 60us);
}

TEST(ClockEstimator, ASourceThatIsCorrectedOftenAddsNoMoreThanTheLastFew) {
  Rig rig;
  for (int i = 0; i < 20; ++i) {
    rig.hear();
    rig.estimator.on_source_correction(200us);
    EXPECT_LE(rig.state().bound, 60us + ClockEstimator::kUpdatesAfterStep * 200us) << i;
    rig.pass(1s);
  }
}

TEST(ClockEstimator, NoCorrectionOfTheSourceIsTooLarge) {
  Rig rig;
  rig.hear();
  for (int i = 0; i < 2; ++i) rig.estimator.on_source_correction(Duration::max());
  EXPECT_EQ(rig.state().reason, ClockReason::too_far);
  EXPECT_NE(rig.state().bound, kUnknownClockError);
}

TEST(ClockEstimator, MeasurementsAfterAStepCountForCorrectionsOfTheSourceToo) {
  Rig rig;
  rig.hear();
  rig.step(1ms);
  rig.estimator.on_source_correction(2200us);
  for (int i = 0; i < ClockEstimator::kUpdatesAfterStep; ++i) {
    rig.pass(1s);
    rig.hear();
  }
  EXPECT_LT(rig.state().bound, 100us);
}

TEST(ClockEstimator, TreatsNonsenseAsNoAnswer) {
  const auto refused = [](auto spoil) {
    Rig rig;
    rig.hear();
    rig.pass(1s);
    rig.tracking.updated = rig.now.wall - rig.tracking.offset;
    spoil(rig.tracking);
    EXPECT_EQ(rig.estimator.take_untrusted(rig.tracking, rig.now.mono, rig.now), Outcome::nonsense);
    EXPECT_EQ(rig.state().bound, 60us + growth(1s, kAgeing)) << "the last reading still counts";
    rig.pass(3s);
    expect_void(rig.state(), ClockReason::silent);
  };
  refused([](Tracking& t) { t.root.dispersion = -1ns; });
  refused([](Tracking& t) { t.root.delay = -1ns; });
  refused([](Tracking& t) { t.root.delay = Duration::max(); });
  refused([](Tracking& t) { t.root.dispersion = Duration::max(); });
  refused([](Tracking& t) { t.offset = Duration::min(); });
  refused([](Tracking& t) { t.offset = Duration::max(); });
  refused([](Tracking& t) { t.rate_ppb = INT64_MIN; });
  refused([](Tracking& t) { t.rate_ppb = 100'000'001; });
  refused([](Tracking& t) { t.update_interval = -1s; });
  refused([](Tracking& t) { t.leap = 4; });
  refused([](Tracking& t) { t.updated = Time::min(); });
  refused([](Tracking& t) { t.updated = Time::max(); });
  refused([](Tracking& t) { t.updated += 2s; });
}

TEST(ClockEstimator, TakesNewSettingsAtOnce) {
  Rig rig;
  rig.hear();
  rig.pass(1s);
  rig.estimator.set({50us, 1'000'000});
  EXPECT_EQ(rig.state().status, ClockStatus::out_of_bounds);
  EXPECT_EQ(rig.state().bound, 60us + growth(1s, 1'125'000));
}

TEST(ClockEstimator, SeesStepsFromBeforeItWasMade) {
  Rig rig;
  EXPECT_EQ(rig.estimator.base()->mono, rig.now.mono);
  for (const Duration step : {0s, 5s, -5s}) {
    ClockEstimator next{ClockEstimator::Settings{}};
    EXPECT_EQ(next.base(), std::nullopt);
    next.resume(*rig.estimator.base(), rig.estimator.setting_from());
    Rig later = rig;
    later.now.mono += 10s;
    later.now.wall += 10s + step;
    EXPECT_EQ(next.observe(later.now), step == 0s ? std::nullopt : std::optional<Duration>(step));
    EXPECT_EQ(next.at(later.now.mono).status, ClockStatus::unknown);
    later.estimator = next;
    EXPECT_EQ(later.hear(), step == 0s ? Outcome::taken : Outcome::stepped);
  }
}

TEST(ClockEstimator, HandsAStepOnUntilItIsMeasured) {
  Rig rig;
  rig.hear();
  rig.step(5s);
  rig.pass(1s);
  rig.hear();
  rig.step(1s);
  const auto seen_by_next = [&] {
    ClockEstimator next{ClockEstimator::Settings{}};
    next.resume(*rig.estimator.base(), rig.estimator.setting_from());
    return next.observe(rig.now);
  };
  EXPECT_EQ(seen_by_next(), Duration(6s));
  for (int i = 0; i < ClockEstimator::kUpdatesAfterStep; ++i) {
    EXPECT_EQ(seen_by_next(), Duration(6s));
    rig.pass(1s);
    rig.hear();
  }
  EXPECT_EQ(rig.state().status, ClockStatus::synchronized);
  EXPECT_EQ(seen_by_next(), std::nullopt);
}

TEST(ClockInstant, IsReadFromBothClocks) {
  const MonoTime mono = MonoClock::now();
  const Time wall = WallClock::now();
  const Instant now = Instant::now();
  EXPECT_GE(now.mono, mono);
  EXPECT_GE(now.wall, wall);
  EXPECT_LE(now.mono + now.width, MonoClock::now());
}

}  // namespace
}  // namespace dssm::clock
