// SPDX-License-Identifier: Apache-2.0
//
// mDNS and DNS-SD through the Avahi daemon: announces this host and its streams, and finds the
// dssmd of other hosts.
//
// libavahi-client asks the Avahi daemon by D-Bus calls that wait for their answers, and a hung
// daemon would stop everything until the timeout of D-Bus (25 s). So all of it runs in a thread of
// its own, with an event loop of its own (AvahiPoll on libevent, see avahi_poll.hpp); what is to be
// announced goes there, and what is found comes back, as messages. While the Avahi daemon or D-Bus
// is not available, it retries.
#pragma once

#include <cstdint>
#include <memory>
#include <string>
#include <thread>
#include <vector>

#include "daemon/base/event_loop.hpp"
#include "daemon/base/log.hpp"
#include "daemon/base/rate_limited_logger.hpp"
#include "daemon/fleet/found_host.hpp"
#include "daemon/fleet/mdns/mdns_mailbox.hpp"
#include "daemon/fleet/service_record.hpp"

namespace dssm::daemon {

class Mdns {
 public:
  struct Options {
    wire::HostId self;
    std::uint16_t
        port;  // announced with every service; `self` and it identify our own announcements
    // Names or patterns (fnmatch(3)) of network interfaces: those in `interfaces`, all when that is
    // empty, without those in `avoid_interfaces`.
    std::vector<std::string> interfaces;
    std::vector<std::string> avoid_interfaces;
    // Between the announcements of two new streams, after the first few.
    Duration stream_pause = std::chrono::microseconds(62'500);
  };

  // Starts at once. loop, observer and logger outlive it; the observer is called from the loop.
  Mdns(const EventLoop& loop, const Options& options, HostFinderObserver& observer, Logger& logger);
  Mdns(const Mdns&) = delete;
  Mdns& operator=(const Mdns&) = delete;
  ~Mdns();  // withdraws what is announced; a hung Avahi daemon delays it by a second at most

  // All that is to be announced from now on. Changes are sent after a moment, so that many
  // in a row become one. Never waits.
  void announce(std::vector<ServiceRecord> records);

 private:
  Result<void> start(const EventLoop& main_loop, const Options& options);
  void on_update();

  HostFinderObserver& observer_;
  RateLimitedLogger logger_;  // how often there is something to log is decided by others
  MdnsInfo state_;
  FoundHosts reported_;
  std::shared_ptr<MdnsMailbox> mailbox_;  // nullptr: it could not be opened
  std::thread thread_;
  EventSource updates_;
};

}  // namespace dssm::daemon
