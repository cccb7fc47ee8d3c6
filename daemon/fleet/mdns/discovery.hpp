// SPDX-License-Identifier: Apache-2.0
//
// Discovery by mDNS as a part of dssmd: announces this host and the streams that it owns as they
// come and go. Peers gets what is found.
#pragma once

#include <cstdint>
#include <string>
#include <vector>

#include "daemon/base/event_loop.hpp"
#include "daemon/base/log.hpp"
#include "daemon/fleet/mdns/mdns.hpp"
#include "daemon/fleet/peers.hpp"
#include "daemon/streams/registry.hpp"

namespace dssm::daemon {

// How others reach a dssmd, from the addresses that it listens at.
struct Reach {
  std::uint16_t port = 0;  // 0: it listens nowhere
  bool closed = true;      // at loopback only

  friend bool operator==(const Reach&, const Reach&) = default;
};
Reach reach_of(const std::vector<std::string>& addresses);

class Discovery final : private StreamObserver {
 public:
  struct Options {
    wire::Greeting self;
    Reach reach;
    bool leaves_pc = false;  // found hosts may be reached over the network
    std::vector<std::string> interfaces, avoid_interfaces;
  };

  // Finds from now on; announces from the first start_announcing() on. What is given by reference
  // outlives it. To be made before the loop runs.
  Discovery(const EventLoop& loop, Options options, Registry& registry, Peers& peers,
            Logger& logger);
  Discovery(const Discovery&) = delete;
  Discovery& operator=(const Discovery&) = delete;
  ~Discovery();

  // To be called once this host serves others.
  void start_announcing();

 private:
  void on_stream_added(const Stream& stream) override;
  void on_stream_described(const Stream& stream) override;
  void on_stream_removed(const Stream& stream) override;
  void announce_soon();
  void announce();

  const Options options_;
  Registry& registry_;
  bool announcing_ = false;
  bool announce_is_due_ = false;
  EventSource announce_timer_;
  Mdns mdns_;  // last: it calls the others
};

}  // namespace dssm::daemon
