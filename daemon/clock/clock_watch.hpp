// SPDX-License-Identifier: Apache-2.0
//
// What this PC's clock is worth at each moment: asks chronyd, watches for steps, keeps the
// estimate, and tells the log what changes. docs/clocks.md
#pragma once

#include <functional>
#include <memory>
#include <optional>
#include <string>

#include "core/clock/clock_estimator.hpp"
#include "core/clock/clock_tick.hpp"
#include "core/wire/address.hpp"
#include "daemon/base/event_loop.hpp"
#include "daemon/base/log.hpp"
#include "daemon/base/rate_limiter.hpp"
#include "daemon/clock/chronyd_client.hpp"
#include "daemon/clock/step_watch.hpp"

namespace dssm::daemon {

class ClockWatch final : private ChronydClient::Observer {
 public:
  struct Options {
    wire::SocketAddress chronyd;
    clock::ClockEstimator::Settings settings;
    // Tests put their own in their places.
    ChronydClient::Now now = clock::Instant::now;
    Duration period = ChronydClient::kPeriod;
    std::function<clock::Tick()> tick = clock::Tick::last;
  };

  class Observer {
   public:
    // Look at state() again: after each answer of chronyd, each period without one, and at once
    // after a step, or when chronyd is found to be gone.
    virtual void on_clock() = 0;

   protected:
    ~Observer() = default;
  };

  // What is given by reference outlives it. Calls the observer from the loop only.
  ClockWatch(const EventLoop& loop, const Options& options, Observer& observer, Logger& logger);
  ClockWatch(const ClockWatch&) = delete;
  ClockWatch& operator=(const ClockWatch&) = delete;

  // Takes over from an earlier dssmd of this boot, whose base() this was: the clock counts as
  // stepped when it was set in between. Before anything else is called.
  void resume(const clock::Instant& base) noexcept { estimator_.resume(base); }
  // Since when the clock is whole: an instant after the last step, or, until chronyd is believed
  // again, one before it.
  clock::Instant base();

  clock::ClockState state();  // at this moment

  // Whether state() may tell something else than when this was asked last. Costs much less, and
  // misses no step; what comes with time alone (chronyd is silent) may be kMostDelay old.
  bool may_differ();
  static constexpr Duration kMostDelay = std::chrono::milliseconds(50);

  // dssmd is awake anyway: chronyd is asked now when that is about due.
  void poll_if_due() { client_.poll_if_due(); }

  // Of chronyd's last answer, while there is a chronyd: whom it follows, and how often it measures.
  std::optional<SourceAddress> source() const noexcept;
  Duration update_interval() const noexcept;  // 0 without one

  void set(const clock::ClockEstimator::Settings& settings) noexcept { estimator_.set(settings); }
  void on_reference(const std::optional<clock::ReferenceReport>& report) noexcept;

 private:
  // What the log tells apart.
  enum class Condition {
    unknown,
    absent,  // chronyd; and the following one, too
    silent,
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

  void look(const clock::Instant& now);
  void changed(const clock::Instant& now);
  Condition condition(const clock::ClockState& state, MonoTime now) const noexcept;
  void tell(Condition condition, const clock::ClockState& state, MonoTime now);
  std::string in_bounds(Condition condition, const clock::ClockState& state, MonoTime now) const;
  std::string too_far(const clock::ClockState& state, MonoTime now) const;

  const std::string where_;  // "chronyd at '127.0.0.1:323'"
  Observer& observer_;
  Logger& logger_;
  const ChronydClient::Now now_;
  const std::function<clock::Tick()> tick_;
  clock::ClockEstimator estimator_;
  std::optional<clock::Tick> seen_tick_;   // before may_differ() was true last
  std::optional<TrackingReply> last_;      // while there is a chronyd
  bool absent_ = false;                    // nothing listens there
  std::optional<MonoTime> waiting_since_;  // no answer since then
  std::string why_;                        // there is none
  Condition seen_ = Condition::unknown, told_ = Condition::unknown;
  // So that a clock that is set every second, or goes in and out of bounds, does not fill the log.
  RateLimiter change_lines_{4, std::chrono::minutes(1)}, step_lines_{4, std::chrono::minutes(1)};
  std::uint64_t unlogged_changes_ = 0;
  std::unique_ptr<StepWatch> step_watch_;  // null: no descriptor was left for it
  ChronydClient client_;                   // last: it calls the others
};

}  // namespace dssm::daemon
