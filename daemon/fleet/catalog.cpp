// SPDX-License-Identifier: Apache-2.0
#include "daemon/fleet/catalog.hpp"

#include <fmt/format.h>

#include <algorithm>

namespace dssm::daemon {
namespace {

// About what a stream's description takes in memory.
std::size_t bytes_of(const StreamInfo& stream) {
  std::size_t bytes = sizeof(StreamInfo) + stream.type.name.size();
  for (const Field& field : stream.type.fields) bytes += sizeof(Field) + field.name.size();
  return bytes;
}

}  // namespace

std::string KnownHost::str() const {
  return fmt::format("host '{}' ('{}')", greeting.host, address.str());
}

void Catalog::add_observer(CatalogObserver& observer) { observers_.push_back(&observer); }

void Catalog::remove_observer(CatalogObserver& observer) { std::erase(observers_, &observer); }

template <class Notify>
void Catalog::notify(const Notify& call) {
  const std::vector<CatalogObserver*> all = observers_;
  for (CatalogObserver* observer : all) {
    // An observer that was notified before may have removed this one.
    if (std::find(observers_.begin(), observers_.end(), observer) != observers_.end()) {
      call(*observer);
    }
  }
}

void Catalog::host_up(const wire::Greeting& greeting, const wire::Address& address) {
  if (const KnownHost* known = find(greeting.host_id)) {
    if (known->greeting.instance_id == greeting.instance_id) return;
    host_down(greeting.host_id, {Errc::unavailable, "its dssmd was restarted"});
  }
  const KnownHost& host =
      hosts_.emplace(greeting.host_id, KnownHost{greeting, address, {}, 0}).first->second;
  notify([&](CatalogObserver& observer) { observer.on_host_up(host); });
}

void Catalog::host_down(const wire::HostId& id, const Error& error) {
  auto removed = hosts_.extract(id);
  if (!removed) return;
  KnownHost& host = down_.emplace_back(std::move(removed.mapped()));
  host.is_down = true;
  notify([&](CatalogObserver& observer) { observer.on_host_down(host, error); });
  report_removed();
}

bool Catalog::report_removed() {
  for (int reported = 0; !down_.empty(); ++reported) {
    KnownHost& host = down_.front();
    if (host.streams.empty()) {
      down_.pop_front();
      continue;
    }
    if (reported >= kRemovedPerTurn) return true;
    const auto removed = host.streams.extract(host.streams.begin());
    // The host may be up again: then this one was reported as added, or will be.
    if (has(removed.mapped().id)) continue;
    notify([&](CatalogObserver& observer) {
      observer.on_remote_stream_removed(host, removed.mapped());
    });
  }
  return false;
}

Result<void> Catalog::stream_added(const wire::HostId& id, StreamInfo stream, bool property_set) {
  const auto found = hosts_.find(id);
  if (found == hosts_.end()) {
    return Error{Errc::not_found, "the host of stream '" + stream.id.str() + "' is not known"};
  }
  const Tid newest = stream.newest;
  // What changes with each sample is as it was when the stream was created.
  stream.oldest = stream.newest = kNoTid;
  stream.rate_hz = 0;
  stream.state = StreamState::unknown;
  KnownHost& host = found->second;
  const auto old = host.streams.find(Key{stream.id.name, stream.id.id});
  const std::size_t old_bytes = old == host.streams.end() ? 0 : bytes_of(old->second);
  if (old == host.streams.end() && host.streams.size() >= kMaxStreamsPerHost) {
    return Error{
        Errc::limit_exceeded,
        fmt::format("{} has more than {} streams, which is more than it can be configured to",
                    host.str(), kMaxStreamsPerHost)};
  }
  const std::size_t others_bytes = host.stream_bytes - old_bytes;
  if (others_bytes + bytes_of(stream) > kMaxBytesPerHost) stream.type.fields = {};
  host.stream_bytes = others_bytes + bytes_of(stream);
  const bool is_known = old != host.streams.end() &&
                        old->second.incarnation == stream.incarnation &&
                        old->second.type == stream.type;
  StreamInfo& entry = host.streams[Key{stream.id.name, stream.id.id}];
  entry = std::move(stream);
  if (!is_known) {
    notify([&](CatalogObserver& observer) { observer.on_remote_stream_added(host, entry); });
  }
  if (property_set) {
    StreamInfo then = entry;
    then.newest = newest;
    notify([&](CatalogObserver& observer) { observer.on_remote_property_set(then); });
  }
  return {};
}

void Catalog::stream_removed(const wire::HostId& id, const StreamId& stream) {
  const auto found = hosts_.find(id);
  if (found == hosts_.end()) return;
  KnownHost& host = found->second;
  const auto removed = host.streams.extract(Key{stream.name, stream.id});
  if (!removed) return;
  host.stream_bytes -= bytes_of(removed.mapped());
  notify([&](CatalogObserver& observer) {
    observer.on_remote_stream_removed(host, removed.mapped());
  });
}

void Catalog::set_clock(const wire::HostId& id, std::shared_ptr<const wire::ClockReport> clock) {
  const auto found = hosts_.find(id);
  if (found == hosts_.end()) return;
  found->second.greeting.clock = std::move(clock);
  notify([&](CatalogObserver& observer) { observer.on_host_clock(found->second); });
}

const KnownHost* Catalog::find(const wire::HostId& id) const {
  const auto found = hosts_.find(id);
  return found == hosts_.end() ? nullptr : &found->second;
}

std::string Catalog::host_names() const {
  std::vector<std::string> names;
  for (const auto& [id, host] : hosts_) names.push_back("'" + host.greeting.host + "'");
  std::sort(names.begin(), names.end());
  std::string text;
  for (const std::string& name : names) text += (text.empty() ? "" : ", ") + name;
  return text;
}

Result<const KnownHost*> Catalog::find_host(const std::string& name) const {
  std::vector<const KnownHost*> found;
  for (const auto& [id, host] : hosts_) {
    if (host.greeting.host == name) found.push_back(&host);
  }
  if (found.size() == 1) return found.front();
  if (found.empty()) {
    const std::string known =
        hosts_.empty() ? ", and no other host answers" : ": those that answer are " + host_names();
    return Error{Errc::not_found,
                 fmt::format("no host '{}' answers{}; see `dssmctl hosts`, and add "
                             "it to the key peers if it is missing there",
                             name, known)};
  }
  std::string addresses;
  for (const KnownHost* host : found) {
    addresses += (addresses.empty() ? "'" : " and '") + host->address.str() + "'";
  }
  return Error{Errc::conflict, fmt::format("several hosts are called '{}', at {}; give each its "
                                           "own name (key name) and restart its dssmd",
                                           name, addresses)};
}

Result<const KnownHost*> Catalog::find_owner(const StreamId& id) const {
  if (!id.host.empty()) return find_host(id.host);
  std::vector<const KnownHost*> found;
  for (const auto& [host_id, host] : hosts_) {
    if (host.streams.contains(Key{id.name, id.id})) found.push_back(&host);
  }
  if (found.size() == 1) return found.front();
  if (found.empty()) {
    const std::string elsewhere =
        hosts_.empty() ? ", and no other host answers" : " or on " + host_names();
    return Error{Errc::not_found, fmt::format("there is no stream '{}' on this host '{}'{}; create "
                                              "it first (`dssmctl ls` lists those that are there)",
                                              id.str(), own_host_, elsewhere)};
  }
  std::sort(found.begin(), found.end(), [](const KnownHost* one, const KnownHost* other) {
    return one->greeting.host < other->greeting.host;
  });
  std::string owners;
  for (const KnownHost* host : found) owners += (owners.empty() ? "" : " and ") + host->str();
  return Error{Errc::conflict,
               fmt::format("several hosts have a stream '{}': {}; say which one: '{}@{}'", id.str(),
                           owners, id.str(), found.front()->greeting.host)};
}

bool Catalog::has(const StreamId& id) const {
  return std::any_of(hosts_.begin(), hosts_.end(), [&](const auto& entry) {
    return entry.second.greeting.host == id.host &&
           entry.second.streams.contains(Key{id.name, id.id});
  });
}

}  // namespace dssm::daemon
