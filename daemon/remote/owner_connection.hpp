// SPDX-License-Identifier: Apache-2.0
//
// The connection of a mirror or a remote writer to the dssmd that owns its stream: follows the host
// to where the catalog finds it, makes sure that it is that host which answers, and connects anew
// for ever.
#pragma once

#include <dssm/result.hpp>
#include <memory>
#include <optional>
#include <string>

#include "daemon/base/event_loop.hpp"
#include "daemon/base/log.hpp"
#include "daemon/fleet/catalog.hpp"
#include "daemon/fleet/clock_assessor.hpp"
#include "daemon/link/dialer.hpp"
#include "daemon/link/resolver.hpp"
#include "daemon/streams/registry.hpp"

namespace dssm::daemon {

// What all channels of this dssmd to other hosts have in common; all of it outlives them.
struct ChannelParts {
  const EventLoop& loop;
  Resolver& resolver;
  Registry& registry;  // for memory and room
  Logger& logger;
  wire::Greeting self;
  const ClockAssessor* clock = nullptr;  // nullptr: the clock is not watched
};

class OwnerConnection final : private Dialer::Observer {
 public:
  // Between two looks whether a stream that was removed or refused can be had.
  static constexpr Duration kRetryPause = std::chrono::seconds(2);

  class Observer : public Dialer::Observer {
   public:
    // Instead of on_down(), when the connection ends because of try_again().
    virtual void on_reopen() = 0;

   protected:
    ~Observer() = default;
  };

  // stream: its name, for messages. All outlive it.
  OwnerConnection(const ChannelParts& parts, std::string stream, Observer& observer);
  OwnerConnection(const OwnerConnection&) = delete;
  OwnerConnection& operator=(const OwnerConnection&) = delete;

  // Whose stream it is, once connect() said so.
  const std::optional<wire::HostId>& owner() const noexcept { return owner_; }
  const wire::Address& address() const noexcept { return address_; }
  FrameConnection* link() noexcept { return dialer_ ? dialer_->link() : nullptr; }

  // The owner answers there. Another host than before: it has taken over the name.
  void connect(const KnownHost& host);
  // The owner does not answer any more: the connection is dead too, even if TCP does not know it.
  void on_owner_down(const Error& why);

  // Asks the owner anew, on a new connection: this one belongs to a stream that is no more, or that
  // was refused. At once, or after kRetryPause.
  void try_again();
  void try_again_later() { retry_timer_.enable_in(kRetryPause); }

 private:
  void on_up(FrameConnection& link, const wire::Greeting& them) override;
  Result<void> on_frame(net::Frame& frame) override { return observer_.on_frame(frame); }
  void on_output_empty() override { observer_.on_output_empty(); }
  void on_down(const Error& why) override;

  const ChannelParts& parts_;
  const std::string stream_;
  Observer& observer_;
  std::optional<wire::HostId> owner_;
  wire::Address address_;
  bool anew_ = false;  // the connection is about to end because we want it to
  EventSource retry_timer_;
  std::unique_ptr<Dialer> dialer_;
};

}  // namespace dssm::daemon
