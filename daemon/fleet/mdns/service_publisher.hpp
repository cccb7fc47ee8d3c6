// SPDX-License-Identifier: Apache-2.0
//
// Reconciles what Avahi announces with what is wanted: one entry group per service, so that one
// changes, collides or fails without the others.
//
// The host comes first; streams are announced when that is done, and a few at a time: all Avahi
// daemons of the network process each one, and a thousand at once would delay their reports about
// hosts (docs/discovery.md "Many streams").
//
// Avahi's stock limits, as its daemon counts them: 1024 objects per client, entry groups and
// resolvers together; 32 entries per entry group, of which a service takes one and each subtype
// another, on each interface that is named. What is beyond is withheld, streams in the order of
// their names.
#pragma once

#include <avahi-client/publish.h>

#include <cstdint>
#include <deque>
#include <map>
#include <string>
#include <vector>

#include "daemon/base/event_loop.hpp"
#include "daemon/base/rate_limiter.hpp"
#include "daemon/fleet/service_record.hpp"

namespace dssm::daemon {

class MdnsWorker;  // owns the AvahiClient

class ServicePublisher {
 public:
  // Leaves objects for the browser and its resolvers.
  static constexpr std::size_t kMaxGroups = 740;
  // Two entries each: half of what a group may hold.
  static constexpr std::size_t kMaxInterfaces = 8;

  // stream_pause: as in Mdns::Options. loop and owner outlive it.
  ServicePublisher(const EventLoop& loop, std::uint16_t port, Duration stream_pause,
                   MdnsWorker& owner);
  ServicePublisher(const ServicePublisher&) = delete;
  ServicePublisher& operator=(const ServicePublisher&) = delete;

  void want(std::vector<ServiceRecord> records);
  // {AVAHI_IF_UNSPEC}: all. Empty: there is none to announce on.
  void use_interfaces(std::vector<AvahiIfIndex> interfaces);

  void start(AvahiClient* client);  // its host name is established; already started: nothing
  void pause();                     // the host name is being changed: withdraws all
  void forget();                    // the client is freed or about to be, with all its groups

  std::uint32_t announced() const;
  std::uint32_t withheld() const;
  std::string problem() const;  // empty: none

 private:
  enum class State : unsigned char { idle, registering, established, withheld };
  struct Service {
    ServicePublisher* publisher = nullptr;
    ServiceRecord record;
    TxtRecord txt;      // as registered
    std::string name;   // the instance, with " #2" after a collision
    std::string error;  // why it is withheld; empty: beyond the limits
    AvahiEntryGroup* group = nullptr;
    State state = State::idle;
    bool wanted = true;
    bool queued = false;
    int renamed = 0;
  };
  using Services = std::map<std::string, Service>;  // by instance

  static void on_group(AvahiEntryGroup* group, AvahiEntryGroupState state, void* service);
  void on_group(Service& service, AvahiEntryGroupState state);
  void queue(Service& service, bool first = false);
  void queue_all();
  void queue_withheld();
  void work();
  bool is_new_stream(const Service& service) const;
  bool host_is_settled() const;
  void queue_new_streams();
  bool bring(Service& service);
  int add(Service& service);
  bool update(Service& service);
  void withhold(Service& service, int error);
  bool rename(Service& service);

  const EventLoop& loop_;
  MdnsWorker& owner_;
  const std::uint16_t port_;
  AvahiClient* client_ = nullptr;
  bool running_ = false;
  std::vector<AvahiIfIndex> interfaces_{AVAHI_IF_UNSPEC};
  Services services_;
  std::deque<std::string> queue_;  // instances to check
  std::size_t groups_ = 0;
  bool logged_withheld_ = false;
  RateLimiter pace_;
  EventSource worker_, retry_;
};

}  // namespace dssm::daemon
