// SPDX-License-Identifier: Apache-2.0
//
// What this PC knows of its own clock, from what chronyd says of it and from comparing the wall
// clock with the monotonic one. No I/O: whoever owns it brings readings and the time.
// docs/clocks.md derives what is done here.
//
//   threads  one
#pragma once

#include <cstdint>
#include <dssm/clock_status.hpp>
#include <dssm/time.hpp>
#include <optional>

#include "core/clock/clock_bound.hpp"

namespace dssm::clock {

// The reference id of a chronyd that follows nobody and is told to take its own time for right
// (`local` in chrony.conf).
inline constexpr std::uint32_t kLocalReferenceId = 0x7f7f0101;

// Both clocks at one instant.
struct Instant {
  MonoTime mono;
  Time wall;
  Duration width{};  // the two were read within this

  // Reads both, again and again for a short while until they are close together.
  static Instant now() noexcept;
};

// What chronyd says of the clock (chronyc(1) tracking), already in our units; rounded upwards where
// that makes a bound larger. Its sender is not trusted: any value may be any.
struct Tracking {
  static constexpr std::uint16_t kUnsynchronized = 3;

  std::uint32_t reference_id = 0;
  std::uint16_t stratum = 0;
  std::uint16_t leap = kUnsynchronized;  // 0 normal, 1 insert, 2 delete a second, 3 unsynchronised
  Time updated;                          // when it last learned something from its sources
  Duration update_interval{};            // between that and the time before
  Duration offset{};                     // this clock minus chronyd's time; positive: ahead
  RootDistance root;
};

// What the reference PC says of its clock: it is the one that a chronyd with `seen_as` for its
// reference id follows.
struct ReferenceReport {
  std::uint32_t seen_as = 0;
  RootDistance root;
};

// The clock at one instant.
struct ClockState {
  ClockStatus status = ClockStatus::unknown;
  ClockReason trouble = ClockReason::none;
  ClockBasis basis = ClockBasis::nothing;
  std::uint16_t stratum = 0;
  std::uint32_t reference_id = 0;  // this and the following: of the last reading; 0 without one
  Duration bound = kUnknownClockError;
  Duration root_bound = kUnknownClockError;  // from the root, whatever the basis
  Duration own_bound = kUnknownClockError;   // from the time that chronyd here keeps
  PartsPerBillion ageing = 0;                // what the bound grows by in a second from here on
  Duration offset{};
  MonoTime read;     // when chronyd was asked
  MonoTime updated;  // when it last learned something
  RootDistance root;

  friend bool operator==(const ClockState& a, const ClockState& b) = default;
};

class ClockEstimator {
 public:
  // A chronyd that has not answered for so long is silent. Two answers may be lost.
  static constexpr Duration kSilentAfter = std::chrono::milliseconds(3500);
  // Measurements after a step that it takes to believe chronyd again. It fits a line through its
  // last measurements, through three at least: from the third on there is such a fit without any
  // from before the step. One more, because the first that is new to us may have been
  // taken just before the step.
  static constexpr int kUpdatesAfterStep = 4;
  // Smaller jumps between the clocks are taken for noise, and added to the bound.
  static constexpr Duration kLeastStep = std::chrono::microseconds(1);
  // What chronyd says of its root may be as old as its oldest measurement. It keeps 64; as many
  // again, and once more both, may have been lost in between.
  static constexpr int kMeasurementsBack = 256;

  struct Settings {
    Duration limit = std::chrono::microseconds(1500);
    PartsPerBillion max_drift = 50'000;
  };

  enum class Verdict : std::uint8_t { taken, unsynchronized, stepped, nonsense };

  explicit ClockEstimator(const Settings& settings) noexcept : settings_(settings) {}
  void set(const Settings& settings) noexcept { settings_ = settings; }
  const Settings& settings() const noexcept { return settings_; }

  // Takes over from an estimator of the same boot, whose base() this was: a step between then and
  // now counts as one that was seen. Before the first look().
  void resume(const Instant& base) noexcept { base_ = base; }
  // An instant since which the clock has not been set; as long as chronyd has not measured anew
  // after a step, one before it, so that whoever resumes from it sees the step, too. nullopt:
  // look() has not looked yet.
  const std::optional<Instant>& base() const noexcept { return stepped_ ? before_step_ : base_; }

  // Compares the clocks; the first thing to do at each instant.
  //   returns  how far the wall clock was set since the last time, if it was: no bound holds any
  //            more until chronyd has measured anew
  std::optional<Duration> look(const Instant& now) noexcept;

  // chronyd's answer to a question that was sent at `asked` and answered at `answered`, at which
  // look() has looked. Nonsense counts as no answer.
  Verdict take_untrusted(const Tracking& tracking, MonoTime asked,
                         const Instant& answered) noexcept;

  // There is no chronyd: nothing listens where it should.
  void on_no_chronyd() noexcept;

  // What the reference PC says, each time it does; nullopt: nothing is known of it any more, or
  // it is this PC. While there is one, a chronyd here in `local` mode is not right by definition.
  void on_reference(const std::optional<ReferenceReport>& report, MonoTime now) noexcept;

  // The state at `now`, at which look() has looked.
  ClockState at(MonoTime now) const noexcept;

 private:
  // The least root distance that the reference PC has stated in the time that our chronyd's may
  // go back to. Minima of two spans of that length, which overlap it.
  struct Reference {
    std::uint32_t seen_as = 0;
    MonoTime since;
    RootDistance before, lately;
    bool whole = false;  // `before` covers a whole span
  };
  struct Reading {
    Tracking tracking;
    MonoTime asked;
    MonoTime updated;
  };

  bool is_nonsense(const Tracking& tracking, const Instant& answered) const noexcept;
  void forget(ClockReason why) noexcept;
  Duration memory() const noexcept;
  bool follows_reference() const noexcept;
  bool is_overdue(MonoTime now) const noexcept;

  Settings settings_;
  std::optional<Instant> base_;         // since the last step
  std::optional<Instant> before_step_;  // of the first step that chronyd has not measured yet
  std::optional<Reading> reading_;
  std::optional<Reference> reference_;
  Duration unseen_{};     // how far the clock may have been set without a step
  bool stepped_ = false;  // and not measured anew
  Time last_update_;      // chronyd's last measurement, by its own time
  int updates_ = 0;       // after the step
  MonoTime heard_;
  ClockReason why_ = ClockReason::none;  // without a reading
  bool heard_ever_ = false;
};

}  // namespace dssm::clock
