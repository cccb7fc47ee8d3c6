// SPDX-License-Identifier: Apache-2.0
//
// A simulated PC that knows the true time: an oscillator that drifts, the kernel's two clocks, a
// chronyd that measures, slews and states its distance, somebody who sets the clock, a watch that
// asks chronyd once a second, and the estimator that is tested. It errs as far as it may: the
// oscillator runs at its worst, and chronyd's time is often as wrong as chronyd says it may be.
//
// All times are in ns. Errors are against the true time, which is that of the reference PC.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <deque>
#include <optional>
#include <random>

#include "daemon/clock/clock_estimator.hpp"

namespace dssm::clock {

class SimulatedPc {
 public:
  struct Traits {
    double drift_ppm = 45;                    // the oscillator's worst
    Duration poll = std::chrono::seconds(1);  // chronyd's, of its source
    double lost_measurements = 0.1;           // share
    double lost_answers = 0.1;                // share of chronyd's answers to the watch
    double steps_per_hour = 0;                // somebody sets the clock
    double own_steps_per_hour = 0;            // chronyd steps it
    double changes_per_hour = 0;              // chronyd selects another source
    bool reference = false;  // the source is the fleet's reference PC, which says so
  };
  // What the bound was in the run.
  struct Tally {
    int observations = 0;
    int stated = 0;  // looks with a bound
    int not_covered = 0;
    int steps = 0;
    double most_ns = 0;   // the largest true error
    double worst_ns = 0;  // the largest true error beyond a stated bound
  };

  SimulatedPc(const Traits& traits, const ClockEstimator::Settings& settings, std::uint32_t seed)
      : traits_(traits), max_drift_(settings.max_drift), estimator_(settings), random_(seed) {
    change_source();
    measure();
    look();
  }

  // Runs for `time`, looking 20 times a second.
  void run(Duration time) {
    for (const std::int64_t end = true_ns_ + time.count(); true_ns_ < end;) tick();
  }

  // chronyd is stopped; refusing: the system says so to who asks.
  void kill_chronyd(bool refusing) {
    alive_ = false;
    refusing_ = refusing;
    offset_ = 0;
  }
  void start_chronyd() {
    alive_ = true;
    measured_ = false;
    next_measurement_ = true_ns_ + kSecond;
  }
  // Somebody sets the clock, and chronyd does not know.
  void step(double by_ns) {
    clock_error_ += by_ns;
    unnoticed_ += by_ns;
    bad_fits_ = 2;
    ++tally_.steps;
    look();
  }

  const Tally& tally() const { return tally_; }
  ClockSnapshot state() const { return estimator_.at(now_.mono); }

 private:
  static constexpr std::int64_t kSecond = 1'000'000'000, kTick = kSecond / 20;
  static constexpr std::size_t kMeasurementsKept = 64;
  static constexpr double kChronysDrift = 1.5e-6;  // what chronyd itself adds to its dispersion

  double uniform(double least, double most) {
    return std::uniform_real_distribution<double>(least, most)(random_);
  }
  bool chance(double probability) { return uniform(0, 1) < probability; }
  bool hourly(double times) { return times > 0 && chance(times / 3600 / 20); }
  double sign() { return chance(0.5) ? 1 : -1; }

  void tick() {
    if (hourly(traits_.steps_per_hour)) step(sign() * std::pow(10.0, uniform(4, 12)));
    if (hourly(traits_.changes_per_hour)) change_source();
    if (alive_ && hourly(traits_.own_steps_per_hour)) {
      clock_error_ -= offset_;
      offset_ = 0;
    }
    if (hourly(600))
      frequency_ = chance(0.7) ? sign() * traits_.drift_ppm * 1e-6
                               : uniform(-1, 1) * traits_.drift_ppm * 1e-6;
    pass(kTick);
    if (alive_ && true_ns_ >= next_measurement_) {
      next_measurement_ = true_ns_ + traits_.poll.count();
      if (!chance(traits_.lost_measurements)) measure();
    }
    look();
    if (true_ns_ >= next_question_) ask();
    check();
  }

  // Time goes by; chronyd slews by a third of the offset in a second, and at most by 8.3 %.
  void pass(std::int64_t time) {
    const auto t = static_cast<double>(time);
    const double slew =
        std::copysign(std::min(std::abs(offset_) * t / (3.0 * kSecond), 0.0833 * t), offset_);
    const double moved = frequency_ * t - slew;
    true_ns_ += time;
    clock_error_ += moved;
    mono_error_ += moved;
    offset_ -= slew;
  }

  void look() {
    const auto mono = true_ns_ + std::llround(mono_error_),
               wall = true_ns_ + std::llround(clock_error_);
    now_ = {MonoTime(std::chrono::hours(1)) + Duration(mono),
            Time(std::chrono::hours(400'000)) + Duration(wall),
            {}};
    estimator_.observe(now_);
  }

  void change_source() {
    link_dispersion_ = std::pow(10.0, uniform(3.5, 5.5));
    link_delay_ = std::pow(10.0, uniform(4.5, 7));
    source_ = traits_.reference ? 1 : source_ + 1;
  }

  // chronyd takes a measurement in: its time is then as wrong as its link makes it, and its root
  // distance that of its source at some earlier measurement that it likes best, and the link's.
  void measure() {
    says_dispersion_ = link_dispersion_ * uniform(0.5, 1);
    says_delay_ = link_delay_ * uniform(0.5, 1);
    const double most = says_dispersion_ + says_delay_ / 2;
    double error = chance(0.5) ? sign() * most : uniform(-most, most);
    unnoticed_ *= bad_fits_ > 0 ? uniform(0, 1) : 0;
    if (bad_fits_ > 0) --bad_fits_;
    error += unnoticed_;
    offset_ = clock_error_ - error;
    if (traits_.reference) {
      if (chance(0.05)) {
        root_ = {Duration(std::llround(std::pow(10.0, uniform(4, 7)))),
                 Duration(std::llround(std::pow(10.0, uniform(4, 7))))};
      }
      roots_.push_back(root_);
      if (roots_.size() > kMeasurementsKept) roots_.pop_front();
      const RootDistance& best = roots_[random_() % roots_.size()];
      says_dispersion_ += static_cast<double>(best.dispersion.count());
      says_delay_ += static_cast<double>(best.delay.count());
    }
    interval_ = measured_ ? true_ns_ - measured_at_ : 0;
    measured_at_ = true_ns_;
    measured_chronys_time_ = now_.wall + Duration(std::llround(-offset_));
    measured_ = true;
    learned_since_reading_ = true;
  }

  Tracking report() {
    Tracking tracking;
    if (!measured_) return tracking;
    tracking.reference_id = source_;
    tracking.stratum = 11;
    tracking.leap = 0;
    tracking.update_interval = Duration(interval_);
    tracking.updated = measured_chronys_time_;
    tracking.offset =
        Duration(static_cast<std::int64_t>(offset_ < 0 ? std::floor(offset_) : std::ceil(offset_)));
    const double age = static_cast<double>(true_ns_ - measured_at_);
    tracking.root = {Duration(std::llround(std::ceil(says_dispersion_ + age * kChronysDrift))),
                     Duration(std::llround(std::ceil(says_delay_)))};
    return tracking;
  }

  // The watch asks; the answer was made at some time between the question and its arrival.
  void ask() {
    next_question_ = true_ns_ + kSecond;
    if (traits_.reference) estimator_.on_reference(ReferenceReport{1, root_}, now_.mono);
    if (!alive_) {
      if (refusing_) estimator_.on_no_chronyd();
      return;
    }
    if (chance(traits_.lost_answers)) return;
    const MonoTime asked = now_.mono;
    const Tracking tracking = report();
    pass(std::llround(uniform(0, 0.2) * kSecond));
    look();
    estimator_.take_untrusted(tracking, asked, now_);
    learned_since_reading_ = false;
  }

  // What chronyd learned since it was asked is not known yet; if it is for the worse, it may slew
  // beyond the bound until it is asked again. Otherwise the bound must cover the true error.
  void check() {
    ++tally_.observations;
    tally_.most_ns = std::max(tally_.most_ns, std::abs(clock_error_));
    const ClockSnapshot state = this->state();
    if (state.bound == kUnknownClockError) return;
    ++tally_.stated;
    auto bound = static_cast<double>(state.bound.count());
    if (learned_since_reading_ && bad_fits_ == 0) {
      const double age = static_cast<double>(true_ns_ - measured_at_);
      bound = std::max(bound, std::abs(offset_) + says_dispersion_ + says_delay_ / 2 +
                                  age * static_cast<double>(max_drift_) * 1e-9);
    }
    const double beyond = std::abs(clock_error_) - bound - 1;  // 1 ns: the clocks count in them
    if (beyond <= 0) return;
    ++tally_.not_covered;
    tally_.worst_ns = std::max(tally_.worst_ns, beyond);
  }

  const Traits traits_;
  const PartsPerBillion max_drift_;
  ClockEstimator estimator_;
  std::mt19937 random_;
  Tally tally_;
  // The PC.
  std::int64_t true_ns_ = 0;
  double frequency_ = 0, clock_error_ = 0, mono_error_ = 0;
  Instant now_;
  // chronyd.
  bool alive_ = true, refusing_ = false, measured_ = false;
  std::int64_t next_measurement_ = 0, measured_at_ = 0, interval_ = 0;
  Time measured_chronys_time_;
  double offset_ = 0;     // the clock minus chronyd's time
  double unnoticed_ = 0;  // what chronyd's fit is still wrong by after a step
  int bad_fits_ = 0;      // that many measurements more
  double link_dispersion_ = 0, link_delay_ = 0, says_dispersion_ = 0, says_delay_ = 0;
  std::uint32_t source_ = 0;
  RootDistance root_;  // of the reference PC
  std::deque<RootDistance> roots_;
  // The watch.
  std::int64_t next_question_ = 0;
  bool learned_since_reading_ = false;
};

}  // namespace dssm::clock
