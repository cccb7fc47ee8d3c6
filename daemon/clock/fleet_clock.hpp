// SPDX-License-Identifier: Apache-2.0
//
// This PC's clock among those of the fleet, and what other hosts' samples are worth here.
// docs/clocks.md "Between two PCs". Who computes, stores and decides about clocks:
//
//   computes  ChronydClient    asks chronyd about once a second (chrony_protocol: the datagrams)
//             StepWatch        is notified by the kernel that the clock was set
//             ClockEstimator   the snapshot of this clock at any moment: bound, status, reason
//             ClockWatch       drives these three and logs changes
//             FleetClock       sync chain and anchor: from the snapshot and other hosts' reports
//             PairMeasurement  how far another PC's oscillator is from this one's, by heartbeats
//             clock_distance   how far two clocks may be apart, from their reports and from that
//   stores    ClockPage        this clock, for stamping (core/clock; written by ClockPageWriter)
//             wire::ClockReport  this clock for other hosts, in our greeting, and theirs in Catalog
//             MirrorClock      one owner's report, and which of its samples are suspect
//             ring header      ring::ClockAssessment of a mirror, or of a stream others write to
//   decides   ClockPolicies    which policy and limit a stream has (configuration)
//             FleetClock       may a stream be served (check_serving); how far are its times from
//                              here, and what is left of the limit (assess_mirror, assess_own)
//             ClockAssessment::is_good()  may this sample be read by time; called by client/src/
//                              reader.cpp with what the ring's header states
//
// May this sample be read by time? In the order of the data: assess_mirror() here with
// clock_distance.cpp, MirrorClock in daemon/remote/mirror_ring.cpp (adds the suspect samples),
// core/ring/clock_assessment.cpp (one sample), client/src/reader.cpp (is_refused).
#pragma once

#include <deque>
#include <functional>
#include <map>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "core/wire/clock_report.hpp"
#include "daemon/base/event_loop.hpp"
#include "daemon/clock/clock_distance.hpp"
#include "daemon/clock/clock_page_writer.hpp"
#include "daemon/clock/clock_watch.hpp"
#include "daemon/clock/host_clock_log.hpp"
#include "daemon/fleet/catalog.hpp"
#include "daemon/fleet/clock_assessor.hpp"
#include "daemon/service/config_values.hpp"

namespace dssm::daemon {

class FleetClock final : public ClockAssessor,
                         private ClockWatch::Observer,
                         private CatalogObserver {
 public:
  // For so long the host that this one follows may be unavailable before this one becomes the
  // reference of the hosts that follow it.
  static constexpr Duration kSuccessionDelay = std::chrono::seconds(5);
  // How far back the shared page states bounds.
  static constexpr Duration kReach = std::chrono::seconds(10);
  // PCs of which measurements are kept; a further one replaces that which was silent the longest.
  static constexpr std::size_t kMaxPairs = 256;
  // A program writes a sample at most so long after the sample's time, or the time counts as that
  // of another clock (kMaxDelay in client/src/states.hpp).
  static constexpr Duration kWrittenWithin = std::chrono::seconds(10);
  // Without a heartbeat for so long, the last measurement ages.
  static constexpr Duration kMeasuredFor = std::chrono::seconds(3);

  struct Options {
    ClockWatch::Options watch;
    ClockPolicies policies;
  };

  // own: this host's report, which is kept up to date from now on. What is given by reference
  // outlives it.
  FleetClock(const EventLoop& loop, const Options& options, clock::ClockPageWriter page,
             std::shared_ptr<wire::ClockReport> own, wire::HostId self, Catalog& catalog,
             Logger& logger);
  FleetClock(const FleetClock&) = delete;
  FleetClock& operator=(const FleetClock&) = delete;
  ~FleetClock();

  // Called from the loop when assessments may have changed, at least once a second; and before that
  // when the clock has a new generation.
  void on_change(std::function<void()> then) { on_change_ = std::move(then); }
  void on_new_generation(std::function<void()> then) { on_new_generation_ = std::move(then); }

  void set(const ClockPolicies& policies, clock::PartsPerBillion max_drift);

  const wire::ClockReport& own() const noexcept { return *own_; }
  // "clock synchronized within 120 us of 'pc1'", for people.
  std::string str() const;

  // dssmd is awake: a question to chronyd that is about due is sent now, which saves a wake-up.
  void poll_if_due() { watch_.poll_if_due(); }
  // What the heartbeats of `host` say of its clock (PairMeasurement::add_returned_untrusted()).
  void add_returned_untrusted(const wire::HostId& host, const clock::HeartbeatTimes& times);
  // How far that host's clock may be from this one's.
  Duration distance_to(const wire::ClockReport& other) const;
  // Why the times of that host's samples are not good here, in a sentence; empty: they are, or
  // clock_policy is off. nullptr: it reports no clock. Not by the exceptions in clock_streams.
  std::string reason_against(const wire::ClockReport* owner) const;
  // Whether reads by time are refused for such a reason; otherwise it is only shown.
  bool refuses() const noexcept { return policies_.general.policy == ClockPolicy::enforce; }
  // The shared page for this PC's programs, for reading (core/clock/clock_page.hpp).
  Result<UniqueFd> page_for_reading() const { return page_.for_reading(); }

  // ClockAssessor
  std::uint64_t clock_generation() override;
  Result<void> check_serving(const StreamId& id, const wire::Greeting& them) const override;
  ring::ClockAssessment assess_mirror(const StreamId& id,
                                      const wire::ClockReport* owner) const override;
  ring::ClockAssessment assess_own(const StreamId& id) const override;
  Error refusal(const StreamId& id, const wire::ClockReport* owner) const override;
  std::vector<ClockPair> clock_pairs() override;

 private:
  // The host whose address chronyd names.
  struct Source {
    wire::HostId id{};
    std::string name;
    std::shared_ptr<const wire::ClockReport> report;  // the latest
    std::optional<MonoTime> unavailable_since;
  };
  // What is measured between this PC and another one.
  struct Pair {
    // One of the clocks was set. The oscillators were not, unless a PC slept: the next heartbeat
    // excludes those before it then.
    void await_heartbeat() {
      stated.clear();
      is_confirmed = false;
    }

    clock::PairMeasurement raws;
    bool is_confirmed = false;  // by a heartbeat since a clock was set
    std::int64_t setting = 0;   // of their clock, while this was measured
    RawTime since{};            // heartbeats from before do not count
    clock::StatedBounds stated;
    clock::WallDifference last;  // the latest
    MonoTime measured_at{};      // then
  };
  // What follows from a Pair at one moment.
  struct Measured {
    clock::WallDifference now;
    bool is_fresh = false;   // else it has aged since the last heartbeat
    clock::PastBounds past;  // for samples with their times, by this PC's clock or theirs
  };

  void on_clock() override;
  void on_host_up(const KnownHost& host) override;
  void on_host_clock(const KnownHost& host) override;
  void on_host_down(const KnownHost& host, const Error& why) override;

  void refresh();
  void find_source(MonoTime now);
  void compare_source(const KnownHost& host);
  const KnownHost* host_at(const wire::IpAddress& address) const;
  bool is_followed() const;
  void update_addresses(MonoTime now);
  void update_chain(MonoTime now);
  void choose_anchor(const ClockSnapshot& watched, MonoTime now);
  void update_status();
  void publish(const clock::Instant& now);
  void update_setting(const clock::Instant& now);
  void update_line(RawTime now);
  void measure(const wire::ClockReport& theirs);
  void state(Pair& pair, const wire::ClockReport& theirs);
  std::optional<clock::WallDifference> walls_of(const Pair& pair,
                                                const wire::ClockReport& theirs) const;
  // limit: earlier samples that were further off are not covered
  std::optional<Measured> measured(const wire::ClockReport& theirs, MonoTime now,
                                   Duration limit) const;
  bool is_outdated(const wire::ClockReport& theirs) const noexcept;
  Duration chain_distance(const wire::ClockReport& theirs, MonoTime now) const;
  void log_others(MonoTime now);
  ring::ClockAssessment assessment(const StreamId& id, MonoTime now) const;
  std::string reason_against(const wire::ClockReport* owner, Duration limit) const;
  Duration distance_of_samples(const wire::ClockReport& owner) const;
  ClockPair pair_with(const wire::Greeting& owner) const;

  Catalog& catalog_;
  clock::ClockPageWriter page_;
  const std::shared_ptr<wire::ClockReport> own_;
  const wire::HostId self_;
  ClockPolicies policies_;
  std::optional<wire::IpAddress> source_address_;
  std::optional<Source> source_;
  MonoTime addresses_read_{};
  std::deque<clock::StatedBound> stated_;  // within kReach; all of them bounds
  std::map<std::string, Pair> pairs_;      // by the boot id of the other PC
  RawTime pairs_since_{};                  // the same for all pairs
  clock::ClockReading rate_from_;          // of the own line
  MonoTime set_at_{};                      // when this clock was set last
  std::uint64_t generation_ = 0;
  std::function<void()> on_change_, on_new_generation_;
  HostClockLog log_;
  ClockWatch watch_;  // last: it calls the others
};

}  // namespace dssm::daemon
