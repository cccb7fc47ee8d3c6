// SPDX-License-Identifier: Apache-2.0
//
// mDNS and DNS-SD through the Avahi daemon: announces this host and its streams, and finds the
// dssmd of other hosts.
//
// libavahi-client asks the Avahi daemon by D-Bus calls that wait for their answers, and a hung
// daemon would stop everything for as long as D-Bus is patient. So all of it runs in a thread of
// its own, with an event loop of its own (AvahiPoll on libevent, see avahi_poll.hpp); what is to be
// announced goes there, and what is found comes back, as messages. When the Avahi daemon, or D-Bus,
// is away, it is looked for again and again.
#pragma once

#include <cstdint>
#include <memory>
#include <string>
#include <vector>

#include "daemon/base/event_loop.hpp"
#include "daemon/base/log.hpp"
#include "daemon/fleet/found_host.hpp"
#include "daemon/fleet/service_record.hpp"

namespace dssm::daemon {

class Mdns {
 public:
  struct Options {
    wire::HostId self;
    std::uint16_t port;  // announced with every service; with `self` it is how we know ourselves
    // Names or patterns (fnmatch(3)) of network interfaces: those in `interfaces`, all when that is
    // empty, without those in `avoid_interfaces`.
    std::vector<std::string> interfaces;
    std::vector<std::string> avoid_interfaces;
    // Between the announcements of two new streams, after the first few.
    Duration stream_pause = std::chrono::microseconds(62'500);
  };

  // Starts at once. loop, observer and logger outlive it; the observer is told from the loop.
  Mdns(const EventLoop& loop, Options options, HostFinderObserver& observer, Logger& logger);
  Mdns(const Mdns&) = delete;
  Mdns& operator=(const Mdns&) = delete;
  ~Mdns();  // withdraws what is announced; a hung Avahi daemon delays it by a second at most

  // What shall be announced from now on, all of it. Changes are sent after a moment, so that many
  // in a row become one. Never waits.
  void announce(std::vector<ServiceRecord> records);

 private:
  struct Impl;
  std::unique_ptr<Impl> impl_;
};

}  // namespace dssm::daemon
