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

#include <atomic>
#include <cstdint>
#include <map>
#include <memory>
#include <mutex>
#include <optional>
#include <string>
#include <thread>
#include <utility>
#include <vector>

#include "core/base/unique_fd.hpp"
#include "daemon/base/event_loop.hpp"
#include "daemon/base/log.hpp"
#include "daemon/fleet/service_record.hpp"

namespace dssm::daemon {

using FoundHosts = std::map<wire::HostId, FoundHost>;

// Between dssmd's loop and the thread that talks to Avahi. Both own it, so that either may outlive
// the other. It holds the newest state of each side, not a queue: neither can be flooded.
class MdnsMailbox {
 public:
  // What the thread has reported since the last call of take_update().
  struct Update {
    std::optional<FoundHosts> hosts;  // all of them
    std::optional<MdnsInfo> state;
    std::vector<std::pair<LogLevel, std::string>> lines;
  };

  static Result<std::shared_ptr<MdnsMailbox>> open();

  // dssmd's side.
  void want(std::vector<ServiceRecord> records);
  void stop();
  int updates_fd() const noexcept { return updates_.get(); }  // readable: there is an update
  Update take_update();
  bool wait_until_done(Duration timeout) const;

  // The thread's side.
  int orders_fd() const noexcept { return orders_.get(); }
  std::optional<std::vector<ServiceRecord>> take_wanted();  // when it has changed
  bool stopping() const noexcept { return stopping_.load(); }
  void report(FoundHosts hosts, MdnsInfo state);
  void log(LogLevel level, std::string text);
  void done();  // the thread is about to end

 private:
  MdnsMailbox() = default;

  UniqueFd orders_, updates_, done_;    // eventfds
  std::atomic<bool> stopping_ = false;  // set before the bell is rung, checked after it is read
  std::mutex mutex_;                    // for all below
  std::optional<std::vector<ServiceRecord>> wanted_;
  Update pending_;
};

// dssmd's side: passes on what is to be announced, and reports what has changed of what was found.
class Mdns {
 public:
  struct Options {
    wire::HostId self;
    std::uint16_t port;  // announced with every service; with `self` it identifies our own
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
