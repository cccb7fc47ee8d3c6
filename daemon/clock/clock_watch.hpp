// SPDX-License-Identifier: Apache-2.0
//
// The snapshot of this PC's clock at each moment: asks chronyd, watches for steps, keeps the
// estimate, and logs what changes. docs/clocks.md
#pragma once

#include <functional>
#include <memory>
#include <optional>
#include <string>

#include "core/wire/address.hpp"
#include "daemon/base/event_loop.hpp"
#include "daemon/base/log.hpp"
#include "daemon/base/rate_limiter.hpp"
#include "daemon/clock/chronyd_client.hpp"
#include "daemon/clock/clock_estimator.hpp"
#include "daemon/clock/clock_tick.hpp"
#include "daemon/clock/step_watch.hpp"

namespace dssm::daemon {

class ClockWatch final : private ChronydClient::Observer {
 public:
  struct Options {
    wire::SocketAddress chronyd;
    clock::ClockEstimator::Settings settings;
    // Tests replace these.
    ChronydClient::Now now = clock::Instant::now;
    Duration period = ChronydClient::kPeriod;
    std::function<clock::Tick()> tick = clock::Tick::last;
  };

  class Observer {
   public:
    // state() may have changed: after each answer of chronyd, each period without one, and at once
    // after a step, or when nothing listens at chronyd's address any more.
    virtual void on_clock() = 0;

   protected:
    ~Observer() = default;
  };

  // What is given by reference outlives it. Calls the observer from the loop only.
  ClockWatch(const EventLoop& loop, const Options& options, Observer& observer, Logger& logger);
  ClockWatch(const ClockWatch&) = delete;
  ClockWatch& operator=(const ClockWatch&) = delete;

  // Continues for an earlier dssmd of this boot, whose base() and setting_from() these were: the
  // clock counts as stepped when it was set in between. Called first.
  void resume(const clock::Instant& base, Time setting_from) noexcept {
    estimator_.resume(base, setting_from);
  }
  // An instant after the last step, or, until chronyd has measured enough after it, one before it.
  clock::Instant base();
  // As in ClockEstimator.
  std::int64_t setting() const noexcept { return estimator_.setting(); }
  Time setting_from() const noexcept { return estimator_.setting_from(); }
  Duration corrected() const noexcept { return estimator_.corrected(); }

  ClockSnapshot state();  // at this moment; `bound` is the distance from the source
  Duration own_bound() const noexcept { return estimator_.own_bound(); }
  // Of the source that the bound is a distance from; 0 without a bound.
  std::uint32_t reference_id();

  // Whether state() may differ from when this was called last. Costs much less, and misses no step;
  // what changes with time alone (chronyd is silent) may be kMaxDelay late.
  bool may_differ();
  static constexpr Duration kMaxDelay = std::chrono::milliseconds(50);

  // Logs the state of this clock, if it has changed: what others get, whose bound may be against
  // another clock than that of the source. The observer calls it each time.
  void log_change(const ClockSnapshot& state);

  // dssmd is awake: a question to chronyd that is about due is sent now.
  void poll_if_due() { client_.poll_if_due(); }
  // Someone slews the clock anew, probably chronyd, which may have measured since it was asked.
  void poll_now() { client_.poll_now(); }
  // By Options::now.
  clock::Instant now() const { return now_(); }

  // The host that chronyd follows, by its last answer.
  std::optional<wire::IpAddress> source() const noexcept;

  void set(const clock::ClockEstimator::Settings& settings) noexcept { estimator_.set(settings); }
  void on_reference(const std::optional<clock::ReferenceReport>& report) noexcept;
  // The clock of the host `name`, which chronyd follows, was set.
  void on_source_step(const std::string& name);
  void on_source_correction(Duration by) noexcept { estimator_.on_source_correction(by); }

 private:
  // What the log distinguishes.
  enum class Condition {
    unknown,
    absent,  // chronyd
    silent,  // chronyd
    unsynchronized,
    stepped,
    too_far,
    holdover,
    good,
  };

  void on_answer(const TrackingReply& reply, MonoTime asked,
                 const clock::Instant& answered) override;
  void on_no_chronyd() override;
  void on_no_answer(const Error& why) override;
  void on_set();

  void observe(const clock::Instant& now);
  Condition condition(const ClockSnapshot& state, MonoTime now) const noexcept;
  void log(Condition condition, const ClockSnapshot& state, MonoTime now);
  std::string in_bounds(Condition condition, const ClockSnapshot& state) const;
  std::string too_far(const ClockSnapshot& state) const;

  const std::string where_;  // "chronyd at '127.0.0.1:323'"
  Observer& observer_;
  Logger& logger_;
  const ChronydClient::Now now_;
  const std::function<clock::Tick()> tick_;
  clock::ClockEstimator estimator_;
  std::optional<clock::Tick> seen_tick_;   // before may_differ() was true last
  std::optional<TrackingReply> last_;      // while there is a chronyd
  bool absent_ = false;                    // nothing listens at its address
  std::optional<MonoTime> waiting_since_;  // no answer since then
  std::string last_error_;                 // why there is none
  Condition seen_ = Condition::unknown, logged_ = Condition::unknown;
  // A clock that is set every second, or goes in and out of bounds, must not fill the log.
  RateLimiter change_lines_{4, std::chrono::minutes(1)}, step_lines_{4, std::chrono::minutes(1)};
  std::uint64_t unlogged_changes_ = 0;
  std::unique_ptr<StepWatch> step_watch_;  // null: no descriptor was left for it
  ChronydClient client_;                   // last: it calls the others
};

}  // namespace dssm::daemon
