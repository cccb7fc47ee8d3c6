// SPDX-License-Identifier: Apache-2.0
//
// Two simulated PCs with a known true difference: oscillators of different speed, wall clocks that
// are slewed and set, heartbeats that take longer one way than the other.
#include "daemon/clock/pair_measurement.hpp"

#include <gtest/gtest.h>

#include <cmath>
#include <cstdlib>
#include <random>

#include "daemon/clock/clock_distance.hpp"
#include "tests/support/sanitized.hpp"

namespace dssm::clock {
namespace {

using namespace std::chrono_literals;

Duration ns(double value) { return Duration(std::llround(value)); }

// An oscillator and the wall clock that is made of it.
struct Pc {
  double raw_ns = 1e12;
  double wall_ns = 1.795e18;
  double rate = 0;        // of the oscillator, beyond the true time
  double correction = 0;  // of the wall clock, beyond the oscillator
  ClockLine line;
  ClockReading rate_from;
  int lines = 0;
  double blur_ns = 0;  // of its readings
  double wrong = 0.1;  // they are wrong by this part of that at most
  std::mt19937 random{7};

  void pass(double true_ns) {
    const double counted = true_ns * (1 + rate);
    raw_ns += counted;
    wall_ns += counted * (1 + correction);
  }
  RawTime raw() const { return RawTime(ns(raw_ns)); }
  Time wall() const { return Time(ns(wall_ns)); }
  void step(double by_ns) {
    wall_ns += by_ns;
    rate_from = reading();
    line = ClockLine::through(rate_from, line.rate);
  }
  ClockReading reading() {
    const double off_ns = std::uniform_real_distribution<double>(-blur_ns, blur_ns)(random) * wrong;
    return {raw() + ns(off_ns), wall(), ns(blur_ns)};
  }
  // As FleetClock does before each batch of samples.
  void keep_line() {
    if (line.shows(reading())) return;
    const ClockReading now = reading();
    if (!line.exists()) rate_from = now;
    line = ClockLine::after(line, rate_from, now);
    ++lines;
  }
};

class PairMeasurementTest : public testing::Test {
 protected:
  PairMeasurementTest() {
    const char* given = std::getenv("DSSM_TEST_SEED");
    const unsigned seed = given ? std::atoi(given) : std::random_device()();
    RecordProperty("seed", std::to_string(seed));
    SCOPED_TRACE(seed);
    random.seed(seed);
    theirs.raw_ns = 5e14;
  }

  double uniform(double least, double most) {
    return std::uniform_real_distribution<double>(least, most)(random);
  }
  void pass(double true_ns) {
    ours.pass(true_ns);
    theirs.pass(true_ns);
  }
  // At least `least_ns` each way, and up to `most_ns` more in one of them; and what the other PC
  // takes.
  void beat(double most_ns = 2e6, double there_ns = 0) {
    const bool is_forth = uniform(0, 1) < 0.5;
    HeartbeatTimes times;
    times.asked = ours.raw();
    pass(least_ns + (is_forth ? uniform(0, most_ns) : 0));
    times.received = theirs.raw();
    pass(there_ns);
    times.sent = theirs.raw();
    pass(least_ns + (is_forth ? 0 : uniform(0, most_ns)));
    times.answered = ours.raw();
    pair.add_untrusted(times);
  }
  // Their heartbeat, right after this one's and as good, and what its answer and the next one say.
  void beat_back(double there_ns = 1e9) {
    HeartbeatTimes times;
    times.asked = ours.raw();
    pass(least_ns);
    times.received = theirs.raw();
    pass(there_ns);
    times.sent = theirs.raw();
    pass(least_ns);
    times.answered = ours.raw();
    pair.add_returned_untrusted(times);
  }
  PairMeasurement::Difference difference() const { return pair.at(ours.raw()).value(); }
  double true_ns() const { return theirs.raw_ns - ours.raw_ns; }
  void expect_true() const {
    const PairMeasurement::Difference found = difference();
    EXPECT_LE(static_cast<double>(to_ns(found.least)), true_ns() + 300);
    EXPECT_GE(static_cast<double>(to_ns(found.greatest)), true_ns() - 300);
  }

  Pc ours, theirs;
  PairMeasurement pair;
  std::mt19937 random;
  double least_ns = 5e4;
};

TEST_F(PairMeasurementTest, OneHeartbeatBoundsTheDifferenceByItsRoundTrip) {
  EXPECT_FALSE(pair.at(ours.raw()));
  beat(0);
  expect_true();
  EXPECT_LE(difference().greatest - difference().least, 101us);
  EXPECT_EQ(pair.best_round_trip(), 100us);
}

TEST_F(PairMeasurementTest, WhatTheOtherPcTakesToAnswerMakesNothingLessExact) {
  theirs.rate = 40e-6;
  for (int i = 0; i < 20; ++i) {
    beat(0, 4e7);
    expect_true();
    EXPECT_LE(difference().greatest - difference().least, i == 0 ? 141us : 105us);
    pass(1e9);
  }
  EXPECT_LE(pair.best_round_trip(), 102us);
  EXPECT_GE(pair.best_round_trip(), 98us);
}

TEST_F(PairMeasurementTest, TheDifferenceIsWithinTheBoundsWhateverTheDelays) {
  for (const double rate : {0.0, 50e-6, -300e-6}) {
    pair.clear();
    theirs.rate = rate;
    for (int i = 0; i < 300; ++i) {
      beat(2e6, uniform(0, 1) < 0.3 ? uniform(0, 5e8) : 0);
      for (int j = 0; j < 10; ++j) {
        pass(1e8);
        expect_true();
      }
    }
  }
}

// The oscillators warm up and cool down: by all that is allowed, at any time.
TEST_F(PairMeasurementTest, TheRateMayChangeByAllThatIsAllowed) {
  theirs.rate = 40e-6;
  least_ns = 100;
  double change = 0;  // of the rate, in a second
  for (int i = 0; i < (test::kIsSanitized ? 1000 : 4000); ++i) {
    if (i % 50 == 0)
      change = 1e-9 * PairMeasurement::kMaxRateChange * (uniform(0, 1) < 0.5 ? -1 : 1);
    beat(i % 2 == 0 ? 0 : 1e5);
    for (int j = 0; j < 20; ++j) {
      theirs.rate += change / 20;
      pass(5e7);
    }
    expect_true();
  }
}

// Half of the best round trip and 30 us; more only while the best heartbeat is old and few others
// are good, so that the rate is not well known.
TEST_F(PairMeasurementTest, TheBoundsAreAsTightAsTheBestRoundTrips) {
  theirs.rate = 35e-6;
  ours.rate = -20e-6;
  constexpr int kSeconds = test::kIsSanitized ? 500 : 2000;
  int tight = 0;
  for (int i = 0; i < 64 + kSeconds; ++i) {
    beat();
    if (i >= 64) {
      const Duration half_width = (difference().greatest - difference().least) / 2;
      if (half_width <= pair.best_round_trip() / 2 + 30us) ++tight;
    }
    pass(1e9);
  }
  EXPECT_GE(tight, kSeconds * 99 / 100) << tight;
}

TEST_F(PairMeasurementTest, AHeartbeatThatTookLongTakesNothingAway) {
  for (int i = 0; i < 10; ++i) {
    beat(1e4);
    pass(1e9);
  }
  const PairMeasurement::Difference before = difference();
  beat(2e9);
  expect_true();
  const PairMeasurement::Difference after = difference();
  EXPECT_LE(after.greatest - after.least, before.greatest - before.least + 200us);
}

TEST_F(PairMeasurementTest, AfterAPcHasSleptOnlyNewHeartbeatsCount) {
  for (int i = 0; i < 20; ++i) {
    beat(1e4);
    pass(1e9);
  }
  ours.pass(5e9);  // theirs stands still
  beat(1e4);
  expect_true();
}

// One's own are slow: then the other PC's say more.
TEST_F(PairMeasurementTest, TheOtherPcsHeartbeatsCountToo) {
  theirs.rate = 60e-6;
  least_ns = 2e6;
  for (int i = 0; i < 30; ++i) {
    beat(0);
    pass(1e9);
  }
  const PairMeasurement::Difference before = difference();
  EXPECT_GE(before.greatest - before.least, 4ms);
  least_ns = 2e4;
  for (int i = 0; i < 30; ++i) {
    beat_back();
    for (int j = 0; j < 10; ++j) {
      pass(1e8);
      expect_true();
    }
  }
  EXPECT_LE(difference().greatest - difference().least, 150us);
  EXPECT_EQ(pair.best_round_trip(), 4ms) << "of this PC's own ones";
}

TEST_F(PairMeasurementTest, TheOtherPcsHeartbeatsAreTrueWhateverTheRateAndTheDelays) {
  for (const double rate : {0.0, 50e-6, -300e-6}) {
    pair.clear();
    theirs.rate = rate;
    for (int i = 0; i < 300; ++i) {
      least_ns = uniform(1e4, 2e5);
      beat(2e6);
      beat_back(uniform(0, 1.5e9));
      for (int j = 0; j < 10; ++j) {
        pass(1e8);
        expect_true();
      }
    }
  }
}

// Whether a clock stood still before or after their heartbeat cannot be told.
TEST_F(PairMeasurementTest, TheOtherPcsHeartbeatsNeverCountAlone) {
  beat_back();
  EXPECT_FALSE(pair.at(ours.raw()));
  for (int i = 0; i < 20; ++i) {
    beat(1e4);
    pass(1e9);
  }
  HeartbeatTimes times;  // their clock goes ahead meanwhile
  times.asked = ours.raw();
  pass(least_ns);
  times.received = theirs.raw();
  theirs.raw_ns += 3e9;
  pass(1e9);
  times.sent = theirs.raw();
  pass(least_ns);
  times.answered = ours.raw();
  pair.add_returned_untrusted(times);
  EXPECT_FALSE(pair.at(ours.raw())) << "it excludes those before";
  beat(1e4);
  expect_true();
  pair.clear();
  beat(1e4);
  times.answered = ours.raw() + 1us;
  pair.add_returned_untrusted(times);  // its answer was before the only one that counts
  expect_true();
}

TEST_F(PairMeasurementTest, HeartbeatsEndWithTheWindow) {
  beat();
  pass(65e9);
  EXPECT_FALSE(pair.at(ours.raw()));
}

TEST_F(PairMeasurementTest, ImpossibleTimesAreIgnored) {
  const RawTime now = ours.raw();
  for (const RawTime bad : {RawTime(Duration::max()), RawTime(Duration::min()), RawTime()}) {
    pair.add_untrusted({now, bad, now, now + 1ms});
    pair.add_untrusted({now, now, bad, now + 1ms});
  }
  pair.add_untrusted({now, now, now, now});
  pair.add_untrusted({now + 1ms, now, now, now});
  pair.add_untrusted({now, now + 1ms, now, now + 1ms});  // sent before it was received
  pair.add_untrusted({now, now, now + 2ms, now + 1ms});  // answered before it was sent
  EXPECT_FALSE(pair.at(now + 1ms));
}

// --- the wall clocks of both

class WallDifferenceTest : public PairMeasurementTest {
 protected:
  void pass_and_keep_lines(double true_ns) {
    pass(true_ns);
    ours.keep_line();
    theirs.keep_line();
  }
  WallDifference walls() const {
    const ClockReading now{ours.raw(), ours.wall(), {}};
    return wall_difference(difference(), theirs.line, ours.line, now).value();
  }
  double true_walls_ns() const { return theirs.wall_ns - ours.wall_ns; }
  void expect_true_walls() const {
    const WallDifference found = walls();
    EXPECT_LE(static_cast<double>(to_ns(found.least)), true_walls_ns() + 1000);
    EXPECT_GE(static_cast<double>(to_ns(found.greatest)), true_walls_ns() - 1000);
  }
  // While their clock is slewed as fast as chronyd can.
  void expect_bounds_of_a_slew() {
    theirs.correction = 0.083;
    ours.keep_line();
    for (int i = 0; i < 300; ++i) {
      beat(1e4);
      for (int j = 0; j < 3; ++j) pass_and_keep_lines(3e5);
      pass_and_keep_lines(3e7);
      if (i >= 3) expect_true_walls();
    }
  }
};

TEST_F(WallDifferenceTest, IsWithinTheBoundsWhileBothAreSlewedAndSet) {
  theirs.rate = 60e-6;
  ours.keep_line();
  theirs.keep_line();
  for (int i = 0; i < 300; ++i) {
    beat(1e5);
    if (i % 3 == 0) theirs.correction = uniform(-1e-4, 1e-4);
    if (i % 5 == 0) ours.correction = uniform(-0.08, 0.08);  // as fast as chronyd can
    if (i % 17 == 0) theirs.step(uniform(-1e10, 1e10));
    for (int j = 0; j < 20; ++j) {
      pass_and_keep_lines(5e7);
      expect_true_walls();
    }
  }
}

// As in a guest of User Mode Linux. Lines that are not needed would be worse than the first ones.
TEST_F(WallDifferenceTest, AClockThatIsReadSlowlyStaysOnItsLine) {
  theirs.blur_ns = 5e3;
  expect_bounds_of_a_slew();
  EXPECT_LE(theirs.lines, 6);
}

TEST_F(WallDifferenceTest, HoldsForReadingsThatAreAsWrongAsTheyMayBe) {
  theirs.blur_ns = 5e3;
  theirs.wrong = 1;
  expect_bounds_of_a_slew();
}

TEST_F(WallDifferenceTest, BetweenTwoReadingsItGrowsNoFasterThanTheAgeing) {
  theirs.correction = -0.08;
  for (int i = 0; i < 10; ++i) {
    beat(1e4);
    pass_and_keep_lines(1e9);
  }
  const WallDifference before = walls();
  pass(1e9);
  const double grown = static_cast<double>(before.ageing);
  EXPECT_LE(static_cast<double>(to_ns(before.least)) - grown, true_walls_ns());
  EXPECT_GE(static_cast<double>(to_ns(before.greatest)) + grown, true_walls_ns());
  EXPECT_LT(grown, 1.1 * 0.08e9);
}

TEST_F(WallDifferenceTest, CoversTheTimeSinceALineWasDrawn) {
  for (int i = 0; i < 10; ++i) {
    beat(1e4);
    pass_and_keep_lines(1e9);
  }
  theirs.step(-2.4e6);
  pass_and_keep_lines(1e6);
  theirs.correction = 0.08;
  pass_and_keep_lines(1e7);
  const double at_line = -true_walls_ns();
  EXPECT_GT(at_line, 1e6);
  pass(1e7);
  EXPECT_LT(-true_walls_ns(), at_line - 7e5);
  EXPECT_GE(static_cast<double>(to_ns(walls().bound())), at_line - 1000);
}

TEST_F(WallDifferenceTest, ALineLastsWhileTheRateOfTheClockDoes) {
  theirs.rate = 60e-6;
  theirs.correction = -59e-6;
  for (int i = 0; i < 600; ++i) pass_and_keep_lines(1e9);
  EXPECT_LE(theirs.lines, 3);
}

TEST_F(WallDifferenceTest, ExcludesAChainThatIsShorterThanItCanBe) {
  ours.keep_line();
  theirs.step(5e6);
  beat(0);
  pass_and_keep_lines(1e6);
  EXPECT_TRUE(walls().excludes(4900us));
  EXPECT_FALSE(walls().excludes(5ms));
  EXPECT_FALSE(walls().excludes(kUnknownClockError));
  theirs.step(-1e7);
  pass_and_keep_lines(1e6);
  EXPECT_TRUE(walls().excludes(4900us));
  EXPECT_FALSE(walls().excludes(5ms));
  EXPECT_GE(walls().bound(), 5ms);
  EXPECT_LE(walls().bound(), 5200us);
}

TEST_F(WallDifferenceTest, NothingIsKnownWithoutALine) {
  beat(0);
  const ClockReading now{ours.raw(), ours.wall(), {}};
  EXPECT_FALSE(wall_difference(difference(), theirs.line, ours.line, now));
}

}  // namespace
}  // namespace dssm::clock
