// SPDX-License-Identifier: Apache-2.0
//
// This PC's clock among those of the fleet: from what the watch says of it, and what the other
// hosts say of theirs, follows where it stands; that is told to the programs of this PC (the shared
// page), to the other hosts (the report in our greeting), and to all who ask what another host's
// samples are worth here (ClockRules). docs/clocks.md "Between two PCs".
#pragma once

#include <deque>
#include <functional>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "core/clock/clock_page.hpp"
#include "core/clock/clock_policies.hpp"
#include "core/wire/clock_report.hpp"
#include "daemon/base/event_loop.hpp"
#include "daemon/clock/clock_watch.hpp"
#include "daemon/clock/host_clock_log.hpp"
#include "daemon/fleet/catalog.hpp"
#include "daemon/fleet/clock_assessor.hpp"

namespace dssm::daemon {

class FleetClock final : public ClockAssessor,
                         private ClockWatch::Observer,
                         private CatalogObserver {
 public:
  // The host that this one follows may be away for so long before those who follow this one take
  // it for their reference.
  static constexpr Duration kPatience = std::chrono::seconds(5);
  // How far back the shared page tells bounds.
  static constexpr Duration kReach = std::chrono::seconds(10);

  struct Options {
    ClockWatch::Options watch;
    clock::ClockPolicies policies;
  };

  // self: with a report of its own, which is kept up to date from now on. What is given by
  // reference outlives it.
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

  void set(const clock::ClockPolicies& policies, clock::PartsPerBillion max_drift);

  const wire::ClockReport& own() const noexcept { return *own_; }
  // "clock synchronized within 120 us of 'pc1'", for people.
  std::string str() const;

  // dssmd is awake: a question to chronyd that is about due is sent now, which saves a wake-up.
  void poll_if_due() { watch_.poll_if_due(); }
  // How far that host's clock may be from this one's.
  Duration distance_to(const wire::ClockReport& other) const;
  // The shared page for this PC's programs, for reading (core/clock/clock_page.hpp).
  Result<UniqueFd> page_for_reading() const { return page_.for_reading(); }

  // ClockAssessor
  std::uint64_t clock_generation() override;
  Result<void> check_serving(const StreamId& id, const wire::Greeting& them) const override;
  ring::ClockAssessment assess_mirror(const StreamId& id,
                                      const wire::ClockReport* owner) const override;
  ring::ClockAssessment assess_own(const StreamId& id) const override;
  Error refusal(const StreamId& id, const wire::ClockReport* owner) const override;

 private:
  // The host whose address chronyd names.
  struct Source {
    wire::HostId id{};
    std::string name;
    std::shared_ptr<const wire::ClockReport> report;  // what it said last
    std::optional<MonoTime> away_since;
  };
  struct Stated {
    Time wall;
    Duration bound;
  };

  void on_clock() override;
  void on_host_clock(const KnownHost& host) override;
  void on_host_down(const KnownHost& host, const Error& why) override;

  void refresh();
  void find_source(MonoTime now);
  const KnownHost* host_at(const SourceAddress& address) const;
  bool is_followed() const;
  void look_up_addresses(MonoTime now);
  void update_chain(const clock::ClockState& state, MonoTime now);
  void choose_anchor(const clock::ClockState& state, MonoTime now);
  void update_status(const clock::ClockState& state);
  void publish(const clock::ClockState& state, const clock::Instant& now);
  void log_others(MonoTime now);
  ring::ClockAssessment assessment(const StreamId& id, MonoTime now, Duration added,
                                   clock::PartsPerBillion ageing) const;
  std::string reason_against(const wire::ClockReport* owner, Duration limit) const;

  Catalog& catalog_;
  clock::ClockPageWriter page_;
  const std::shared_ptr<wire::ClockReport> own_;
  const wire::HostId self_;
  clock::ClockPolicies policies_;
  std::optional<SourceAddress> source_address_;
  std::optional<Source> source_;
  MonoTime addresses_read_{};
  std::deque<Stated> stated_;  // within kReach; all of them bounds
  bool was_in_bounds_ = false;
  std::uint64_t generation_ = 0;
  std::function<void()> on_change_, on_new_generation_;
  HostClockLog log_;
  ClockWatch watch_;  // last: it calls the others
};

}  // namespace dssm::daemon
