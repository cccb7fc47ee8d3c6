// SPDX-License-Identifier: Apache-2.0
//
// What this PC knows of its own clock, from chronyd's answers and from comparing the wall clock
// with the monotonic one. No I/O: the caller brings answers and the time. docs/clocks.md derives
// it.
//
//   threads  one
#pragma once

#include <array>
#include <cstdint>
#include <dssm/clock_status.hpp>
#include <dssm/time.hpp>
#include <optional>

#include "core/clock/clock_bound.hpp"

namespace dssm::clock {

// The reference id of a chronyd that follows no source and whose own time counts as right (`local`
// in chrony.conf).
inline constexpr std::uint32_t kLocalReferenceId = 0x7f7f0101;

// The clocks at one instant.
struct Instant {
  MonoTime mono;
  Time wall;
  Duration width{};  // all were read within this
  RawTime raw{};

  // Reads all, several times until they are close together.
  static Instant now() noexcept;
};

// chronyd's answer about the clock (chronyc(1) tracking), in our units; rounded upwards where that
// makes a bound larger. Not trusted: any field can have any value.
struct Tracking {
  static constexpr std::uint16_t kUnsynchronized = 3;

  std::uint32_t reference_id = 0;
  std::uint16_t stratum = 0;
  std::uint16_t leap = kUnsynchronized;  // 0 normal, 1 insert, 2 delete a second, 3 unsynchronised
  Time updated;                          // when it last learned something from its sources
  Duration update_interval{};            // between that and the time before
  Duration offset{};                     // this clock minus chronyd's time; positive: ahead
  PartsPerBillion rate_ppb = 0;          // by so much chronyd's time gains on the RawClock
  RootDistance root;
};

// What the reference PC reports of its clock. A chronyd that follows it has `seen_as` for its
// reference id.
struct ReferenceReport {
  std::uint32_t seen_as = 0;
  RootDistance root;
};

class ClockEstimator {
 public:
  // A chronyd that has not answered for so long is silent. Two answers may be lost.
  static constexpr Duration kSilentAfter = std::chrono::milliseconds(3500);
  // Measurements after a step until chronyd's answers are used again. It fits a line through its
  // last measurements, at least three: from the third on such a fit has none from before the step.
  // One more, because the first that is new here may have been taken just before the step.
  static constexpr int kUpdatesAfterStep = 4;
  // Smaller jumps between the clocks count as noise, and are added to the bound.
  static constexpr Duration kMinStep = std::chrono::microseconds(1);
  // chronyd's values of its root may be as old as its oldest measurement. It keeps 64, and for each
  // of them three others may have been lost.
  static constexpr int kMeasurementsBack = 256;

  struct Settings {
    Duration limit = std::chrono::microseconds(1500);
    PartsPerBillion max_drift = 50'000;
  };

  // By less than this chronyd's time may move with a measurement: that is within the jitter that a
  // chronyd which follows it states.
  static constexpr Duration kMinCorrection = std::chrono::microseconds(100);

  enum class Outcome : std::uint8_t { taken, unsynchronized, stepped, nonsense };

  explicit ClockEstimator(const Settings& settings) noexcept : settings_(settings) {}
  void set(const Settings& settings) noexcept { settings_ = settings; }
  const Settings& settings() const noexcept { return settings_; }

  // Continues an estimator of the same boot, whose base() and setting_from() these were: a step
  // between then and now counts as one that was observed. Before the first observe().
  void resume(const Instant& base, Time setting_from) noexcept {
    base_ = base;
    setting_from_ = setting_from;
  }
  // An instant since which the clock has not been set; as long as chronyd has not measured enough
  // after a step, one before it, so that an estimator that resumes from it observes the step too.
  // nullopt: before the first observe().
  const std::optional<Instant>& base() const noexcept { return stepped_ ? before_step_ : base_; }

  // Changes with each step; 0 before the first observe().
  std::int64_t setting() const noexcept {
    return base_ ? to_ns(base_->mono.time_since_epoch()) : 0;
  }
  // Times by this clock from here on are of the present setting: none before the last step was as
  // late. 1970 when no step was observed.
  Time setting_from() const noexcept { return setting_from_; }

  // Compares the clocks; called first at each instant.
  //   returns  how far the wall clock was set since the last time, if it was: there is no bound
  //            until chronyd has measured kUpdatesAfterStep times
  std::optional<Duration> observe(const Instant& now) noexcept;

  // chronyd's answer to a question that was sent at `asked` and answered at `answered`, after
  // observe(answered). Impossible values count as no answer.
  Outcome take_untrusted(const Tracking& tracking, MonoTime asked,
                         const Instant& answered) noexcept;

  // There is no chronyd: nothing listens at its address.
  void on_no_chronyd() noexcept;

  // Each report of the reference PC; nullopt: it is not known any more, or it is this PC. While
  // there is one, a chronyd here in `local` mode is not right by definition.
  void on_reference(const std::optional<ReferenceReport>& report, MonoTime now) noexcept;

  // The clock that chronyd follows was set: as after a step of this one, there is no bound until
  // chronyd has measured kUpdatesAfterStep times.
  void on_source_step() noexcept;

  // The time of the source that chronyd follows was corrected by so much since the last call: added
  // to the bound until chronyd has measured kUpdatesAfterStep times. More than a year counts as
  // one.
  void on_source_correction(Duration by) noexcept;

  // The sum of all corrections of chronyd's time of kMinCorrection or more, of either sign: by so
  // much that time may have left what others measured.
  Duration corrected() const noexcept { return corrected_; }

  // The clock at `now`, after observe(now). `bound` is its distance from the source that chronyd
  // follows.
  ClockSnapshot at(MonoTime now) const noexcept;
  // That of the source that chronyd follows; 0 without a reading.
  std::uint32_t reference_id() const noexcept {
    return reading_ ? reading_->tracking.reference_id : 0;
  }
  // Its distance from the time that chronyd here keeps; kUnknownClockError without a bound.
  Duration own_bound() const noexcept;

 private:
  // The least root distance that the reference PC has stated within memory(), which our chronyd's
  // values may be as old as. Minima of the present span of that length and of the one before it.
  struct Reference {
    std::uint32_t seen_as = 0;
    MonoTime since;
    RootDistance before, lately;
    bool is_complete = false;  // `before` covers a whole span
  };
  struct Reading {
    Tracking tracking;
    MonoTime asked;
    MonoTime updated;
  };
  // What chronyd's clock showed, within `width`.
  struct ChronydTime {
    Time time;
    RawTime raw;
    Duration width{};
  };

  bool is_nonsense(const Tracking& tracking, const Instant& answered) const noexcept;
  void forget(ClockReason reason) noexcept;
  Duration memory() const noexcept;
  void find_correction(const Tracking& tracking, MonoTime asked, const Instant& answered) noexcept;
  bool follows_reference() const noexcept;
  bool is_overdue(MonoTime now) const noexcept;

  Settings settings_;
  std::optional<Instant> base_;         // since the last step
  std::optional<Instant> before_step_;  // of the first step that chronyd has not measured yet
  Time setting_from_{};
  std::optional<Reading> reading_;
  std::optional<Reference> reference_;
  Duration noise_{};             // how far the clock may have been set without a step
  bool stepped_ = false;         // and not measured kUpdatesAfterStep times since
  bool source_stepped_ = false;  // likewise
  // Corrections of the source, by how often chronyd has measured since.
  std::array<Duration, kUpdatesAfterStep> source_corrected_{};
  std::optional<ChronydTime> chronyd_time_;  // at its last answer; none since the last step
  Duration corrected_{};                     // of chronyd's time
  Time last_update_;                         // chronyd's last measurement, by its own time
  MonoTime last_updated_;                    // the same by ours
  int updates_ = 0;                          // after the step
  MonoTime answered_;                        // the question of the last answer was sent
  ClockReason reason_ = ClockReason::none;   // why there is no reading
  bool has_answered_ = false;
};

}  // namespace dssm::clock
