// SPDX-License-Identifier: Apache-2.0
//
// Every call here is a D-Bus call that waits for its answer, about five for a new service. So they
// are made in turns of a few services, between which the loop serves other events of Avahi.
#include "daemon/fleet/mdns/service_publisher.hpp"

#include <avahi-common/alternative.h>
#include <avahi-common/error.h>
#include <avahi-common/malloc.h>
#include <fmt/format.h>

#include <algorithm>
#include <memory>
#include <utility>

#include "daemon/fleet/mdns/avahi_poll.hpp"
#include "daemon/fleet/mdns/mdns_worker.hpp"

namespace dssm::daemon {
namespace {

constexpr int kServicesPerTurn = 16;
// Before the pauses begin. Few PCs have more.
constexpr int kStreamsAtOnce = 32;
// After so many collisions in a row another PC claims every name that is tried.
constexpr int kMaxRenames = 20;
// Until what was refused is tried again.
constexpr Duration kWithheldPause = std::chrono::seconds(30);

struct FreeStringList {
  void operator()(AvahiStringList* list) const noexcept { avahi_string_list_free(list); }
};
using StringList = std::unique_ptr<AvahiStringList, FreeStringList>;

StringList string_list(const TxtRecord& txt) {
  AvahiStringList* list = nullptr;
  // Each one goes to the front, and the Avahi daemon puts the last one first: on the network they
  // are in our order, which matters for txtvers (RFC 6763 section 6.7).
  for (const auto& [key, value] : txt) {
    list = value.empty() ? avahi_string_list_add(list, key.c_str())
                         : avahi_string_list_add_pair_arbitrary(
                               list, key.c_str(),
                               reinterpret_cast<const std::uint8_t*>(value.data()), value.size());
  }
  return StringList(list);
}

const std::string& service_type() {
  static const std::string type(kServiceType);
  return type;
}

}  // namespace

ServicePublisher::ServicePublisher(const EventLoop& loop, std::uint16_t port, Duration stream_pause,
                                   MdnsWorker& owner)
    : loop_(loop), owner_(owner), port_(port), pace_(kStreamsAtOnce, stream_pause) {
  worker_ = EventSource::timer(loop, [this] { work(); });
  retry_ = EventSource::timer(loop, [this] { queue_withheld(); });
}

void ServicePublisher::want(std::vector<ServiceRecord> records) {
  for (auto& [instance, service] : services_) service.wanted = false;
  for (ServiceRecord& record : records) {
    std::string instance = record.instance();
    const auto [at, added] = services_.try_emplace(std::move(instance));
    Service& service = at->second;
    service.wanted = true;
    if (added) {
      service.publisher = this;
      service.name = at->first;
    } else if (service.record == record) {
      continue;
    }
    service.record = std::move(record);
    if (service.record.stream) queue(service);
  }
  // Removed services free quota for new ones; and the host is what others browse.
  for (auto& [instance, service] : services_) {
    if (!service.wanted) queue(service, true);
  }
  for (auto& [instance, service] : services_) {
    if (service.wanted && !service.record.stream) queue(service, true);
  }
}

void ServicePublisher::use_interfaces(std::vector<AvahiIfIndex> interfaces) {
  if (interfaces == interfaces_) return;
  interfaces_ = std::move(interfaces);
  queue_all();
}

void ServicePublisher::start(AvahiClient* client) {
  if (running_ && client == client_) return;
  client_ = client;
  running_ = true;
  queue_all();
}

void ServicePublisher::pause() {
  if (!running_) return;
  running_ = false;
  queue_all();
}

void ServicePublisher::forget() {
  client_ = nullptr;
  running_ = false;
  groups_ = 0;
  retry_.disable();
  for (auto at = services_.begin(); at != services_.end();) {
    Service& service = at->second;
    service.group = nullptr;
    service.state = State::idle;
    service.error.clear();
    service.name = at->first;
    service.renamed = 0;
    at = service.wanted ? std::next(at) : services_.erase(at);
  }
}

std::uint32_t ServicePublisher::announced() const {
  return static_cast<std::uint32_t>(
      std::count_if(services_.begin(), services_.end(),
                    [](const auto& entry) { return entry.second.state == State::established; }));
}

std::uint32_t ServicePublisher::withheld() const {
  return static_cast<std::uint32_t>(
      std::count_if(services_.begin(), services_.end(),
                    [](const auto& entry) { return entry.second.state == State::withheld; }));
}

std::string ServicePublisher::problem() const {
  const std::uint32_t count = withheld();
  if (count == 0) return {};
  const auto first = std::find_if(services_.begin(), services_.end(), [](const auto& entry) {
    return entry.second.state == State::withheld;
  });
  const std::string reason =
      first->second.error.empty()
          ? fmt::format(
                "more than {} would exceed what Avahi grants one program "
                "(objects-per-client-max). They are found all the same by every dssmd that "
                "knows this host",
                kMaxGroups)
          : first->second.error;
  return count == 1 ? fmt::format("1 service is not announced, '{}': {}", first->first, reason)
                    : fmt::format("{} services are not announced, '{}' first: {}", count,
                                  first->first, reason);
}

void ServicePublisher::queue(Service& service, bool first) {
  if (!service.queued) {
    service.queued = true;
    const std::string instance = service.record.instance();
    if (first) {
      queue_.push_front(instance);
    } else {
      queue_.push_back(instance);
    }
  }
  worker_.enable_in(Duration::zero());
}

// All of them again: with another client, other interfaces, or not at all.
void ServicePublisher::queue_all() {
  for (auto& [instance, service] : services_) {
    service.state = State::idle;
    if (service.record.stream) queue(service);
  }
  for (auto& [instance, service] : services_) {
    if (!service.record.stream) queue(service, true);
  }
}

void ServicePublisher::queue_withheld() {
  for (auto& [instance, service] : services_) {
    if (service.state != State::withheld) continue;
    service.renamed = 0;
    queue(service);
  }
}

void ServicePublisher::work() {
  for (int n = 0; n < kServicesPerTurn && !queue_.empty(); ++n) {
    if (owner_.stopping()) return;
    const std::string instance = std::move(queue_.front());
    queue_.pop_front();
    const auto at = services_.find(instance);
    if (at == services_.end()) continue;
    if (is_new_stream(at->second)) {
      const MonoTime now = loop_.now();
      if (const Duration pause = pace_.wait(now); pause > Duration::zero()) {
        // All others wait, too; what must not wait is queued before it, see want().
        queue_.push_front(instance);
        worker_.enable_in(pause);
        return owner_.on_avahi_change();
      }
      if (!host_is_settled()) {
        at->second.queued = false;  // queue_new_streams() comes back to it
        continue;
      }
      pace_.take(now);
    }
    at->second.queued = false;
    if (!bring(at->second)) return owner_.on_avahi_failure(avahi_client_errno(client_));
    if (!at->second.wanted) services_.erase(at);
  }
  if (!queue_.empty()) worker_.enable_in(Duration::zero());
  owner_.on_avahi_change();
}

bool ServicePublisher::is_new_stream(const Service& service) const {
  return client_ && running_ && service.wanted && service.record.stream &&
         service.state == State::idle;
}

// Announced, or it cannot be.
bool ServicePublisher::host_is_settled() const {
  return std::none_of(services_.begin(), services_.end(), [](const auto& entry) {
    const Service& service = entry.second;
    return service.wanted && !service.record.stream &&
           (service.state == State::idle || service.state == State::registering);
  });
}

void ServicePublisher::queue_new_streams() {
  for (auto& [instance, service] : services_) {
    if (is_new_stream(service)) queue(service);
  }
}

// Does what there is to do for one service.
//   returns  false: there is no talking to Avahi
bool ServicePublisher::bring(Service& service) {
  if (!client_) return true;  // start() comes back to it
  int error = AVAHI_OK;
  if (!service.wanted) {
    if (!service.group) return true;
    error = avahi_entry_group_free(std::exchange(service.group, nullptr));
    --groups_;
    // Another group fits now.
    if (groups_ + 1 == kMaxGroups) queue_withheld();
    return !is_avahi_connection_error(error);
  }
  if (!running_ || interfaces_.empty()) {
    if (service.group) error = avahi_entry_group_reset(service.group);
    service.state = running_ ? State::withheld : State::idle;
    service.error = running_ ? "none of the network interfaces that are configured exists" : "";
    return !is_avahi_connection_error(error);
  }
  const bool stands = service.state == State::registering || service.state == State::established;
  if (stands) {
    if (update(service)) return true;
    if (is_avahi_connection_error(avahi_client_errno(client_))) return false;
  }
  if (!service.group) {
    if (groups_ >= kMaxGroups) {
      withhold(service, AVAHI_OK);
      return true;
    }
    service.group = avahi_entry_group_new(client_, on_group, &service);
    if (!service.group) {
      error = avahi_client_errno(client_);
      withhold(service, error);
      return !is_avahi_connection_error(error);
    }
    ++groups_;
  }
  error = add(service);
  if (error == AVAHI_OK) {
    // Its callback may have been called already.
    if (service.state != State::established) service.state = State::registering;
    return true;
  }
  withhold(service, error);
  return !is_avahi_connection_error(error);
}

// Whether it is as it should be, after changing its TXT record if that is all that it takes.
bool ServicePublisher::update(Service& service) {
  const TxtRecord txt = service.record.txt();
  if (txt == service.txt) return true;
  const StringList list = string_list(txt);
  for (const AvahiIfIndex interface : interfaces_) {
    if (avahi_entry_group_update_service_txt_strlst(
            service.group, interface, AVAHI_PROTO_UNSPEC, AvahiPublishFlags{}, service.name.c_str(),
            service_type().c_str(), nullptr, list.get()) != AVAHI_OK) {
      return false;
    }
  }
  service.txt = txt;
  return true;
}

// From nothing to a committed group.
int ServicePublisher::add(Service& service) {
  service.txt = service.record.txt();
  const StringList list = string_list(service.txt);
  const std::string subtype = service.record.subtype();
  for (;;) {
    int error = AVAHI_OK;
    service.state = State::idle;
    const int empty = avahi_entry_group_is_empty(service.group);
    if (empty < 0) return empty;
    if (empty == 0) error = avahi_entry_group_reset(service.group);
    for (const AvahiIfIndex interface : interfaces_) {
      if (error != AVAHI_OK) break;
      error = avahi_entry_group_add_service_strlst(
          service.group, interface, AVAHI_PROTO_UNSPEC, AvahiPublishFlags{}, service.name.c_str(),
          service_type().c_str(), nullptr, nullptr, port_, list.get());
      if (error != AVAHI_OK) break;
      error = avahi_entry_group_add_service_subtype(
          service.group, interface, AVAHI_PROTO_UNSPEC, AvahiPublishFlags{}, service.name.c_str(),
          service_type().c_str(), nullptr, subtype.c_str());
    }
    if (error == AVAHI_OK) return avahi_entry_group_commit(service.group);
    // Another program of this PC has that name.
    if (error != AVAHI_ERR_COLLISION || !rename(service)) return error;
  }
}

bool ServicePublisher::rename(Service& service) {
  if (service.renamed == kMaxRenames) return false;
  char* const name = avahi_alternative_service_name(service.name.c_str());
  service.name = name;
  avahi_free(name);
  ++service.renamed;
  return true;
}

void ServicePublisher::withhold(Service& service, int error) {
  service.state = State::withheld;
  service.error =
      error == AVAHI_OK ? "" : "Avahi refuses it: " + std::string(avahi_strerror(error));
  if (error != AVAHI_OK) retry_.enable_in(kWithheldPause);
  if (!logged_withheld_ && !is_avahi_connection_error(error)) {
    logged_withheld_ = true;
    owner_.log(LogLevel::warning, "mDNS: " + problem());
  }
  if (!service.record.stream) queue_new_streams();
}

void ServicePublisher::on_group(AvahiEntryGroup*, AvahiEntryGroupState state, void* service) {
  auto& of = *static_cast<Service*>(service);
  of.publisher->on_group(of, state);
}

void ServicePublisher::on_group(Service& service, AvahiEntryGroupState state) {
  // While it is made, or about to be freed or registered again, its state does not count.
  if (!service.group || !service.wanted || !running_) return;
  switch (state) {
    case AVAHI_ENTRY_GROUP_ESTABLISHED:
      service.state = State::established;
      service.renamed = 0;
      if (!service.record.stream) queue_new_streams();
      break;
    case AVAHI_ENTRY_GROUP_COLLISION:
      // Another PC has that name: "pc2 #2". The TXT record identifies this host.
      if (rename(service)) {
        service.state = State::idle;
        queue(service);
      } else {
        withhold(service, AVAHI_ERR_COLLISION);
      }
      break;
    case AVAHI_ENTRY_GROUP_FAILURE:
      withhold(service, avahi_client_errno(client_));
      break;
    case AVAHI_ENTRY_GROUP_REGISTERING:
    case AVAHI_ENTRY_GROUP_UNCOMMITED:
      break;
  }
  owner_.on_avahi_change();
}

}  // namespace dssm::daemon
