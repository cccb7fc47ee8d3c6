// SPDX-License-Identifier: Apache-2.0
//
// Finds the dssmd of all hosts: browses for their host services, resolves them, and merges what
// was heard on several interfaces, by IPv4 and IPv6, into one host per id.
//
// A resolver stays as long as its result, because a changed TXT record or address is reported only
// to resolvers. So results are bounded: the ones beyond wait for the place of one that was removed
// or is of no use, so that a PC that announces invalid records cannot displace the valid ones.
#pragma once

#include <avahi-client/lookup.h>

#include <compare>
#include <cstdint>
#include <map>
#include <optional>
#include <set>
#include <string>

#include "daemon/base/event_loop.hpp"
#include "daemon/fleet/mdns/interface_filter.hpp"
#include "daemon/fleet/mdns/mdns.hpp"

namespace dssm::daemon {

class MdnsWorker;  // owns the AvahiClient

class HostBrowser {
 public:
  static constexpr std::size_t kMaxResults = 256;
  static constexpr std::size_t kMaxWaiting = 4096;  // as many as Avahi remembers records
  static constexpr std::size_t kMaxAddresses = 16;  // of one host

  // All outlive it.
  //   self, port  of this host's own service
  HostBrowser(const EventLoop& loop, const wire::HostId& self, std::uint16_t port,
              const InterfaceFilter& filter, MdnsWorker& owner);
  HostBrowser(const HostBrowser&) = delete;
  HostBrowser& operator=(const HostBrowser&) = delete;

  void start(AvahiClient* client);  // already started: nothing
  void forget();                    // the client is freed or about to be, with all of ours

  FoundHosts hosts() const;           // without this very one
  bool own_host_seen() const;         // this host's own service
  std::uint32_t hosts_heard() const;  // others that are not of this PC
  std::string problem() const;        // empty: none

 private:
  struct Key {
    AvahiIfIndex interface = 0;
    AvahiProtocol protocol = 0;
    std::string instance, domain;
    auto operator<=>(const Key&) const = default;
  };
  struct Heard {
    ServiceRecord record;
    std::string address;  // numbers, as in wire::Address
    int rank = 0;         // less is better
    std::uint16_t port = 0;
    bool local = false;  // announced by this PC's Avahi
  };
  struct Result {
    HostBrowser* browser = nullptr;
    Key key;
    AvahiServiceResolver* resolver = nullptr;
    std::optional<Heard> heard;
    bool useless = false;  // it did not resolve, or is no record of ours
    bool logged_bad = false;
  };

  static void on_browser(AvahiServiceBrowser* browser, AvahiIfIndex interface,
                         AvahiProtocol protocol, AvahiBrowserEvent event, const char* name,
                         const char* type, const char* domain, AvahiLookupResultFlags flags,
                         void* self);
  static void on_resolver(AvahiServiceResolver* resolver, AvahiIfIndex interface,
                          AvahiProtocol protocol, AvahiResolverEvent event, const char* name,
                          const char* type, const char* domain, const char* host_name,
                          const AvahiAddress* address, std::uint16_t port, AvahiStringList* txt,
                          AvahiLookupResultFlags flags, void* result);
  void on_new(Key key);
  void on_removed(const Key& key);
  void on_resolved_untrusted(Result& result, const AvahiAddress* address, std::uint16_t port,
                             AvahiStringList* txt, bool local);
  void on_not_resolved(Result& result);
  void resolve(Result& result);
  bool is_own(const Heard& heard) const;
  void check_contest(Result& result);
  void free_resolver(Result& result);
  bool make_room();
  void refill();
  void resolve_again();

  const wire::HostId self_;
  const std::uint16_t port_;
  const InterfaceFilter& filter_;
  MdnsWorker& owner_;
  AvahiClient* client_ = nullptr;
  AvahiServiceBrowser* browser_ = nullptr;
  std::map<Key, Result> results_;
  std::set<Key> waiting_;  // beyond kMaxResults
  bool logged_full_ = false;
  EventSource retry_, refill_;
};

}  // namespace dssm::daemon
