// SPDX-License-Identifier: Apache-2.0
//
// What this PC's clock is worth at each moment: asks chronyd, watches for steps, keeps the estimate,
// and tells the log what changes. docs/clocks.md
#pragma once

#include <functional>
#include <memory>
#include <optional>
#include <string>

#include "core/clock/clock_estimator.hpp"
#include "core/wire/address.hpp"
#include "daemon/clock/chronyd_client.hpp"
#include "daemon/clock/step_watch.hpp"
#include "daemon/discovery/pace.hpp"
#include "daemon/service/event_loop.hpp"
#include "daemon/service/log.hpp"

namespace dssm::daemon {

class ClockWatch final : private ChronydClient::User {
 public:
  struct Options {
    wire::SocketAddress chronyd;
    clock::ClockEstimator::Settings settings;
    ChronydClient::Now now = clock::Instant::now;  // tests put their own in its place
  };

  class Observer {
   public:
    // Look at state() again: after each answer of chronyd, each second without one, and at once
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

  // Of chronyd's last answer, while there is a chronyd: whom it follows, and how often it measures.
  std::optional<SourceAddress> source() const noexcept;
  Duration update_interval() const noexcept;  // 0 without one

  void set(const clock::ClockEstimator::Settings& settings) noexcept { estimator_.set(settings); }
  void on_reference(const std::optional<clock::ReferenceReport>& report) noexcept;
};

}  // namespace dssm::daemon
