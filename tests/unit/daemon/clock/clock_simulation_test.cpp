// SPDX-License-Identifier: Apache-2.0
//
// Long runs of simulated PCs that know the true time: the stated bound covers the true error at
// every look. And the other way round: an estimator that is told less than the truth is found out,
// so these runs would notice.
#include "tests/unit/daemon/clock/clock_simulation.hpp"

#include <gtest/gtest.h>

#include <cstdlib>

#include "tests/support/sanitized.hpp"

namespace dssm::clock {
namespace {

using namespace std::chrono_literals;
using Traits = SimulatedPc::Traits;

constexpr ClockEstimator::Settings kFiftyPpm{Duration(1500us), 50'000};
constexpr int kRuns = 20;
// Of what must hold: under a sanitizer, where all is slower, the code matters more than the clock.
constexpr int kCoveredRuns = test::kIsSanitized ? 2 : kRuns;

// The same in each run, so that what fails here fails again; DSSM_TEST_SEED tries others.
std::uint32_t first_seed() {
  const char* text = std::getenv("DSSM_TEST_SEED");
  return text ? static_cast<std::uint32_t>(std::strtoul(text, nullptr, 10)) : 1;
}

// Runs `kCoveredRuns` PCs for `time` each: all stated bounds hold, and mostly there is one.
void expect_covered(const Traits& traits, const ClockEstimator::Settings& settings, Duration time,
                    double least_stated = 0.5) {
  const std::uint32_t seed = first_seed();
  SCOPED_TRACE("DSSM_TEST_SEED=" + std::to_string(seed));
  double observations = 0, stated = 0;
  for (std::uint32_t i = 0; i < kCoveredRuns; ++i) {
    SimulatedPc pc(traits, settings, seed + i);
    pc.run(time);
    EXPECT_EQ(pc.tally().not_covered, 0) << "PC " << i << ", by " << pc.tally().worst_ns << " ns";
    observations += pc.tally().observations;
    stated += pc.tally().stated;
  }
  EXPECT_GT(stated, observations * least_stated)
      << "a bound that is never stated covers everything";
}

int not_covered(const Traits& traits, const ClockEstimator::Settings& settings) {
  int sum = 0;
  for (std::uint32_t i = 0; i < kRuns; ++i) {
    SimulatedPc pc(traits, settings, first_seed() + i);
    pc.run(30min);
    sum += pc.tally().not_covered;
  }
  return sum;
}

TEST(SimulatedClock, IsCoveredWhileChronydMeasuresEverySecond) {
  expect_covered({}, kFiftyPpm, 1h, 0.99);
}

TEST(SimulatedClock, IsCoveredWhenItDriftsBy200Ppm) {
  expect_covered({.drift_ppm = 200}, {Duration(1500us), 200'000}, 1h, 0.99);
}

TEST(SimulatedClock, IsCoveredWhenMostMeasurementsAndAnswersAreLost) {
  expect_covered({.lost_measurements = 0.9, .lost_answers = 0.7}, kFiftyPpm, 1h);
}

TEST(SimulatedClock, IsCoveredWhenChronydMeasuresOnceAMinute) {
  expect_covered({.poll = 64s}, kFiftyPpm, 2h, 0.9);
}

TEST(SimulatedClock, IsCoveredWhenItIsSteppedBothWays) {
  expect_covered({.steps_per_hour = 30}, kFiftyPpm, 1h);
}

TEST(SimulatedClock, IsCoveredWhenChronydStepsIt) {
  expect_covered({.own_steps_per_hour = 30}, kFiftyPpm, 1h);
}

TEST(SimulatedClock, IsCoveredWhenChronydChangesItsReference) {
  expect_covered({.changes_per_hour = 60}, kFiftyPpm, 1h, 0.9);
}

TEST(SimulatedClock, IsCoveredAgainstAReferencePcWhoseOwnDistanceChanges) {
  expect_covered({.changes_per_hour = 10, .reference = true}, kFiftyPpm, 1h, 0.9);
}

TEST(SimulatedClock, IsCoveredWhenAllGoesWrongTogether) {
  for (const bool reference : {false, true}) {
    expect_covered({.drift_ppm = 200,
                    .lost_measurements = 0.4,
                    .lost_answers = 0.3,
                    .steps_per_hour = 20,
                    .own_steps_per_hour = 20,
                    .changes_per_hour = 20,
                    .reference = reference},
                   {Duration(1500us), 200'000}, 2h, 0.3);
  }
}

TEST(SimulatedClock, IsCoveredThroughAnHourWithoutChronyd) {
  for (const bool refusing : {true, false}) {
    SimulatedPc pc({}, kFiftyPpm, first_seed());
    SCOPED_TRACE("DSSM_TEST_SEED=" + std::to_string(first_seed()));
    pc.run(10min);
    pc.kill_chronyd(refusing);
    pc.run(5s);
    const int stated = pc.tally().stated;
    pc.run(1h);
    EXPECT_EQ(pc.tally().stated, stated) << "a bound without a chronyd";
    EXPECT_EQ(pc.state().status, ClockStatus::out_of_bounds);
    EXPECT_GT(pc.tally().most_ns, 1.5e6) << "it did drift away meanwhile";
    pc.start_chronyd();
    pc.run(20s);
    EXPECT_NE(pc.state().bound, kUnknownClockError);
    EXPECT_EQ(pc.tally().not_covered, 0) << pc.tally().worst_ns;
  }
}

TEST(SimulatedClock, HasNoBoundFromTheStepOn) {
  for (const double by : {2e8, -2e8, 3.6e12, -3.6e12}) {
    SimulatedPc pc({.lost_measurements = 0, .lost_answers = 0}, kFiftyPpm, first_seed());
    pc.run(1min);
    ASSERT_NE(pc.state().bound, kUnknownClockError);
    pc.step(by);
    EXPECT_EQ(pc.state().bound, kUnknownClockError);
    EXPECT_EQ(pc.state().reason, ClockReason::stepped);
    pc.run(10s);
    EXPECT_NE(pc.state().bound, kUnknownClockError);
    EXPECT_EQ(pc.tally().not_covered, 0);
  }
}

// What max_drift is for: a clock that drifts more than the configuration says is not covered.
TEST(SimulatedClock, IsNotCoveredWhenItDriftsBeyondMaxDrift) {
  EXPECT_GT(not_covered({.drift_ppm = 200, .poll = 64s}, kFiftyPpm), 0);
  EXPECT_GT(not_covered({.drift_ppm = 45, .poll = 64s}, {Duration(1500us), 0}), 0);
}

}  // namespace
}  // namespace dssm::clock
