// SPDX-License-Identifier: Apache-2.0
//
// Everything here comes from any PC on the network: names, addresses, TXT records and how many
// there are of them.
#include "daemon/fleet/mdns/host_browser.hpp"

#include <arpa/inet.h>
#include <avahi-common/error.h>
#include <avahi-common/malloc.h>
#include <fmt/format.h>
#include <netinet/in.h>

#include <algorithm>
#include <cstring>
#include <vector>

#include "core/base/text.hpp"
#include "daemon/fleet/mdns/avahi_poll.hpp"
#include "daemon/fleet/mdns/mdns_worker.hpp"

namespace dssm::daemon {
namespace {

// Until a resolver that could not be made is tried again.
constexpr Duration kResolverPause = std::chrono::seconds(5);
constexpr int kRefillPerTurn = 32;
constexpr std::size_t kMaxTxtPairs = 64;

// The pairs of a TXT record; fails when it is larger than any of ours.
Result<TxtRecord> txt_untrusted(AvahiStringList* list) {
  TxtRecord txt;
  std::size_t bytes = 0;
  for (AvahiStringList* one = list; one; one = avahi_string_list_get_next(one)) {
    bytes += 1 + avahi_string_list_get_size(one);
    if (bytes > kMaxTxtBytes || txt.size() == kMaxTxtPairs) {
      return Error{Errc::protocol,
                   fmt::format("its TXT record is larger than {} bytes or has more than {} keys",
                               kMaxTxtBytes, kMaxTxtPairs)};
    }
    char* key = nullptr;
    char* value = nullptr;
    std::size_t size = 0;
    if (avahi_string_list_get_pair(one, &key, &value, &size) != 0) continue;
    txt.emplace_back(key, value ? std::string(value, size) : std::string());
    avahi_free(key);
    avahi_free(value);
  }
  return txt;
}

struct RankedAddress {
  std::string text;
  int rank;
};

// IPv4 before IPv6, and what is valid everywhere before what is valid on one link. An
// announcement must not direct us to this host itself, or to a multicast address.
std::optional<RankedAddress> address_untrusted(const AvahiAddress& address,
                                               const std::string& interface, bool local) {
  char text[INET6_ADDRSTRLEN] = "";
  if (address.proto == AVAHI_PROTO_INET) {
    const std::uint32_t bits = ntohl(address.data.ipv4.address);
    ::inet_ntop(AF_INET, &address.data.ipv4.address, text, sizeof text);
    if (bits >> 24 == 127) {
      return local ? std::optional(RankedAddress{text, 0}) : std::nullopt;
    }
    if (bits >> 24 == 0 || bits >> 28 >= 14) return std::nullopt;
    return RankedAddress{text, bits >> 16 == 0xa9fe ? 2 : 1};  // 169.254.0.0/16
  }
  if (address.proto != AVAHI_PROTO_INET6) return std::nullopt;
  in6_addr bits;
  static_assert(sizeof bits == sizeof address.data.ipv6.address);
  std::memcpy(&bits, address.data.ipv6.address, sizeof bits);
  ::inet_ntop(AF_INET6, &bits, text, sizeof text);
  if (IN6_IS_ADDR_LOOPBACK(&bits)) {
    return local ? std::optional(RankedAddress{text, 0}) : std::nullopt;
  }
  if (IN6_IS_ADDR_UNSPECIFIED(&bits) || IN6_IS_ADDR_MULTICAST(&bits) ||
      IN6_IS_ADDR_V4MAPPED(&bits) || IN6_IS_ADDR_V4COMPAT(&bits)) {
    return std::nullopt;
  }
  if (!IN6_IS_ADDR_LINKLOCAL(&bits)) return RankedAddress{text, 3};
  return RankedAddress{std::string(text) + "%" + interface, 4};
}

}  // namespace

HostBrowser::HostBrowser(const EventLoop& loop, const wire::HostId& self, std::uint16_t port,
                         const InterfaceFilter& filter, MdnsWorker& owner)
    : self_(self), port_(port), filter_(filter), owner_(owner) {
  retry_ = EventSource::timer(loop, [this] { resolve_again(); });
  refill_ = EventSource::timer(loop, [this] { refill(); });
}

void HostBrowser::start(AvahiClient* client) {
  if (browser_) return;
  client_ = client;
  const std::string type(kHostSubtype);
  browser_ = avahi_service_browser_new(client, AVAHI_IF_UNSPEC, AVAHI_PROTO_UNSPEC, type.c_str(),
                                       nullptr, AvahiLookupFlags{}, on_browser, this);
  if (!browser_) owner_.on_avahi_failure(avahi_client_errno(client));
}

void HostBrowser::forget() {
  client_ = nullptr;
  browser_ = nullptr;
  results_.clear();
  waiting_.clear();
  retry_.disable();
  refill_.disable();
}

// What this PC announces with our id and our port is ours. Our id alone has a copy of this PC, too.
bool HostBrowser::is_own(const Heard& heard) const {
  return heard.local && heard.record.host_id == self_ && heard.port == port_;
}

FoundHosts HostBrowser::hosts() const {
  struct Merged {
    const Heard* best = nullptr;  // names and describes the host
    std::vector<const Heard*> all;
  };
  std::map<wire::HostId, Merged> merged;
  for (const auto& [key, result] : results_) {
    if (!result.heard || is_own(*result.heard)) continue;
    Merged& host = merged[result.heard->record.host_id];
    host.all.push_back(&*result.heard);
    // What this PC's own Avahi announces cannot be a claim of another PC.
    if (!host.best || (result.heard->local && !host.best->local)) host.best = &*result.heard;
  }
  FoundHosts hosts;
  for (auto& [id, host] : merged) {
    const ServiceRecord& record = host.best->record;
    FoundHost found{id, record.host, record.protocol_version, record.closed, {}};
    if (host.best->local) found.addresses.push_back({"127.0.0.1", host.best->port});
    std::stable_sort(host.all.begin(), host.all.end(),
                     [](const Heard* a, const Heard* b) { return a->rank < b->rank; });
    for (const Heard* heard : host.all) {
      if (record.closed || found.addresses.size() == kMaxAddresses) break;
      const wire::Address address{heard->address, heard->port};
      const auto same = std::find(found.addresses.begin(), found.addresses.end(), address);
      if (same == found.addresses.end()) found.addresses.push_back(address);
    }
    hosts.emplace(id, std::move(found));
  }
  return hosts;
}

bool HostBrowser::own_host_seen() const {
  return std::any_of(results_.begin(), results_.end(), [this](const auto& entry) {
    return entry.second.heard && is_own(*entry.second.heard);
  });
}

std::uint32_t HostBrowser::hosts_heard() const {
  std::set<wire::HostId> heard, local;
  for (const auto& [key, result] : results_) {
    if (!result.heard || is_own(*result.heard)) continue;
    (result.heard->local ? local : heard).insert(result.heard->record.host_id);
  }
  return static_cast<std::uint32_t>(std::count_if(
      heard.begin(), heard.end(), [&](const auto& id) { return !local.contains(id); }));
}

std::string HostBrowser::problem() const {
  if (waiting_.empty()) return {};
  return fmt::format(
      "more than {} hosts, counted once per interface and protocol, announce themselves; the "
      "others are left out (name them as peers)",
      kMaxResults);
}

void HostBrowser::on_browser(AvahiServiceBrowser*, AvahiIfIndex interface, AvahiProtocol protocol,
                             AvahiBrowserEvent event, const char* name, const char*,
                             const char* domain, AvahiLookupResultFlags, void* self) {
  auto& browser = *static_cast<HostBrowser*>(self);
  switch (event) {
    case AVAHI_BROWSER_NEW:
      browser.on_new(Key{interface, protocol, name, domain});
      break;
    case AVAHI_BROWSER_REMOVE:
      browser.on_removed(Key{interface, protocol, name, domain});
      break;
    case AVAHI_BROWSER_FAILURE:
      browser.owner_.on_avahi_failure(avahi_client_errno(browser.client_));
      break;
    case AVAHI_BROWSER_CACHE_EXHAUSTED:
    case AVAHI_BROWSER_ALL_FOR_NOW:
      break;
  }
}

void HostBrowser::on_new(Key key) {
  if (results_.contains(key)) return;
  const std::string interface = interface_name(key.interface);
  if (interface.empty() || !filter_.admits(interface)) return;
  if (waiting_.size() < kMaxWaiting) waiting_.insert(std::move(key));
  refill_.enable_in(Duration::zero());
}

// Gives places to those that wait; a few at a time, because each costs D-Bus calls.
void HostBrowser::refill() {
  for (int n = 0; n < kRefillPerTurn && !waiting_.empty(); ++n) {
    if (owner_.stopping() || !client_) return;
    if (results_.size() >= kMaxResults && !make_room()) {
      if (!std::exchange(logged_full_, true)) owner_.log(LogLevel::warning, "mDNS: " + problem());
      return owner_.on_avahi_change();
    }
    const auto next = waiting_.extract(waiting_.begin());
    Result& result = results_[next.value()];
    result.browser = this;
    result.key = next.value();
    resolve(result);
  }
  if (!waiting_.empty()) refill_.enable_in(Duration::zero());
}

void HostBrowser::on_removed(const Key& key) {
  waiting_.erase(key);
  const auto at = results_.find(key);
  if (at == results_.end()) return;
  free_resolver(at->second);
  results_.erase(at);
  if (!waiting_.empty()) refill_.enable_in(Duration::zero());
  owner_.on_avahi_change();
}

bool HostBrowser::make_room() {
  const auto at = std::find_if(results_.begin(), results_.end(),
                               [](const auto& entry) { return entry.second.useless; });
  if (at == results_.end()) return false;
  free_resolver(at->second);
  results_.erase(at);
  return true;
}

void HostBrowser::resolve(Result& result) {
  const auto& [interface, protocol, name, domain] = result.key;
  const std::string type(kServiceType);
  // The address of the family by which it was heard: the other one has a result of its own.
  result.resolver = avahi_service_resolver_new(client_, interface, protocol, name.c_str(),
                                               type.c_str(), domain.c_str(), protocol,
                                               AvahiLookupFlags{}, on_resolver, &result);
  if (result.resolver) return;
  const int error = avahi_client_errno(client_);
  result.useless = true;
  if (is_avahi_connection_error(error)) return owner_.on_avahi_failure(error);
  retry_.enable_in(kResolverPause);
}

void HostBrowser::resolve_again() {
  for (auto& [key, result] : results_) {
    if (!result.resolver && client_ && !owner_.stopping()) resolve(result);
  }
}

// Two hosts cannot be at one address and port, nor another with our id at ours. When two PCs had
// one name until Avahi gave one of them another, a resolver keeps the address that it heard first,
// also after that has become the other one's: both are resolved again.
void HostBrowser::check_contest(Result& result) {
  for (auto& [key, other] : results_) {
    if (!other.heard || (other.heard->record.host_id == result.heard->record.host_id &&
                         is_own(*other.heard) == is_own(*result.heard))) {
      continue;
    }
    if (other.heard->address != result.heard->address || other.heard->port != result.heard->port) {
      continue;
    }
    free_resolver(result);
    free_resolver(other);
    retry_.enable_in(kResolverPause);
  }
}

void HostBrowser::free_resolver(Result& result) {
  if (result.resolver) avahi_service_resolver_free(std::exchange(result.resolver, nullptr));
}

void HostBrowser::on_resolver(AvahiServiceResolver*, AvahiIfIndex, AvahiProtocol,
                              AvahiResolverEvent event, const char*, const char*, const char*,
                              const char*, const AvahiAddress* address, std::uint16_t port,
                              AvahiStringList* txt, AvahiLookupResultFlags flags, void* result) {
  auto& of = *static_cast<Result*>(result);
  if (event == AVAHI_RESOLVER_FOUND) {
    of.browser->on_resolved_untrusted(of, address, port, txt,
                                      (flags & AVAHI_LOOKUP_RESULT_LOCAL) != 0);
  } else {
    of.browser->on_not_resolved(of);
  }
  HostBrowser& browser = *of.browser;
  if (of.useless && !browser.waiting_.empty()) browser.refill_.enable_in(Duration::zero());
  browser.owner_.on_avahi_change();
}

void HostBrowser::on_resolved_untrusted(Result& result, const AvahiAddress* address,
                                        std::uint16_t port, AvahiStringList* txt, bool local) {
  result.heard.reset();
  result.useless = true;
  const std::string interface = interface_name(result.key.interface);
  const auto bad = [&](const std::string& reason) {
    if (std::exchange(result.logged_bad, true)) return;
    owner_.log(LogLevel::warning,
               fmt::format("mDNS: {} on interface {} calls itself a DSSM host, but {}, skipping",
                           in_quotes(result.key.instance), in_quotes(interface), reason));
  };
  const dssm::Result<TxtRecord> pairs = txt_untrusted(txt);
  if (!pairs) return bad(pairs.error().message);
  dssm::Result<ServiceRecord> record = service_record_untrusted(*pairs);
  if (!record) return bad(record.error().message);
  if (record->stream) return bad("its TXT record is that of a stream");
  const std::optional<RankedAddress> usable =
      address ? address_untrusted(*address, interface, local) : std::nullopt;
  if (!usable || port == 0) return bad("its address or port cannot be reached");
  result.heard = Heard{*std::move(record), usable->text, usable->rank, port, local};
  result.useless = false;
  result.logged_bad = false;
  check_contest(result);
}

// No host answers for it (any more). A resolver that timed out continues to listen.
void HostBrowser::on_not_resolved(Result& result) {
  result.heard.reset();
  result.useless = true;
  const int error = avahi_client_errno(client_);
  if (error == AVAHI_ERR_TIMEOUT) return;
  // Freed inside its own callback, as Avahi's examples do, and recreated later.
  free_resolver(result);
  retry_.enable_in(kResolverPause);
}

}  // namespace dssm::daemon
