// SPDX-License-Identifier: Apache-2.0
//
// The mirrors of this dssmd, or its remote writers: finds or makes the entry for a stream of
// another host, gives each what the catalog knows of its owner, and destroys those that are done.
// An entry is known by the name, id and host's name of its stream, as programs write them; where
// several rings of one stream may be in use, further ones are numbered.
#pragma once

#include <map>
#include <memory>
#include <string>
#include <tuple>
#include <utility>

#include "core/base/try.hpp"
#include "daemon/remote/remote_stream.hpp"

namespace dssm::daemon {

// Kind: Mirror or RemoteWriter. Kind::kSeveralRings: several rings of one stream may be in use.
template <class Kind>
class RemoteStreams final : private CatalogObserver {
 public:
  // parts and catalog outlive it.
  RemoteStreams(const ChannelParts& parts, Catalog& catalog)
      : parts_(parts), catalog_(catalog), sweep_(EventSource::timer(parts.loop, [this] {
          std::erase_if(entries_, [](const auto& entry) { return entry.second->done(); });
        })) {
    catalog_.add_observer(*this);
  }
  RemoteStreams(const RemoteStreams&) = delete;
  RemoteStreams& operator=(const RemoteStreams&) = delete;
  ~RemoteStreams() { catalog_.remove_observer(*this); }

  // The ring for `id`, a stream of `host`: the one that is there, or a new one: a mirror with
  // the owner's newest sample, or a remote writer's after the owner agreed. The stream's id names
  // the owner's host. The ring is kept while the OpenTable has it, and a while longer.
  //   host   used during the call only
  //   plan   for remote writers: create the stream there unless it exists; nullptr: it must exist.
  //          Used during the call only
  //   then   called once, from the loop or at once; not after this is destroyed
  //   account  who is charged for a new ring, also when others use it later, as
  //            Identity::account()
  //   waits_for_history  of a mirror: also for what others have asked for and is on its way
  //   fails  not_found, type_mismatch, unavailable (the owner does not answer), limit_exceeded,
  //          conflict (two hosts of that name), clock_out_of_bounds
  void open(const KnownHost& host, const StreamId& id, const CreatePlan* plan,
            RemoteStream::Then then, const std::string& account = {},
            bool waits_for_history = true) {
    const Result<Kind*> found = find_or_connect(host, id, account);
    if (!found) return then(found.error());
    (*found)->open(plan, std::move(then), waits_for_history);
  }

  // Takes a ring that a program held while dssmd was not running. `id` names the owner's host,
  // which need not be in the catalog yet. Two offers of one ring are one entry. A stream may have
  // another ring by now: then it is a second remote writer, but a conflict for a mirror.
  //   fails  conflict, protocol, no_permission, limit_exceeded
  Result<std::shared_ptr<Stream>> adopt_untrusted(const StreamId& id, OfferedFiles files,
                                                  const std::string& account = {}) {
    Key key = key_of(id);
    for (;; ++std::get<3>(key)) {
      Kind& entry = *DSSM_TRY(find_or_make(key, account));
      // NOLINTNEXTLINE(bugprone-use-after-move): a conflict leaves the files as they are
      Result<std::shared_ptr<Stream>> stream = entry.adopt_untrusted(std::move(files));
      if (Kind::kSeveralRings && !stream && stream.error().code == Errc::conflict) continue;
      if (!entry.is_needed()) {
        entries_.erase(key);
      } else if (!entry.connection().owner()) {
        // Else it is connected when the owner is found.
        if (const auto host = catalog_.find_host(id.host)) entry.connection().connect(**host);
      }
      return stream;
    }
  }

  // Whatever its owner is doing; nullptr: none. Without a host in `id`: the only one of that name.
  Kind* find(const StreamId& id) const {
    if (!id.host.empty()) {
      const auto found = entries_.find(key_of(id));
      return found == entries_.end() ? nullptr : found->second.get();
    }
    const auto first = entries_.lower_bound(key_of(id));
    const auto is_named = [&](auto entry) {
      return entry != entries_.end() && std::get<0>(entry->first) == id.name &&
             std::get<1>(entry->first) == id.id;
    };
    return is_named(first) && !is_named(std::next(first)) ? first->second.get() : nullptr;
  }

  template <class Work>
  void for_each(const Work& work) const {
    for (const auto& [key, entry] : entries_) work(*entry);
  }

 private:
  // Name, id, host's name; 0, or the number of a further ring.
  using Key = std::tuple<std::string, std::int32_t, std::string, std::uint64_t>;
  static Key key_of(const StreamId& id) { return {id.name, id.id, id.host, 0}; }

  Result<Kind*> find_or_connect(const KnownHost& host, const StreamId& id,
                                const std::string& account) {
    const StreamId full{id.name, id.id, host.greeting.host};
    Kind* entry = DSSM_TRY(find_or_make(key_of(full), account));
    OwnerConnection& connection = entry->connection();
    if (connection.owner() && *connection.owner() != host.greeting.host_id &&
        catalog_.find(*connection.owner())) {
      return Error{Errc::conflict, "stream '" + full.str() + "': two hosts are called '" +
                                       full.host +
                                       "', and the other one's is in use here; give each its own "
                                       "name (key name) and restart its dssmd"};
    }
    connection.connect(host);
    return entry;
  }

  Result<Kind*> find_or_make(const Key& key, const std::string& account) {
    if (const auto found = entries_.find(key); found != entries_.end()) return found->second.get();
    StreamId id{std::get<0>(key), std::get<1>(key), std::get<2>(key)};
    RingQuota quota = DSSM_TRY(parts_.registry.acquire_quota(account), "stream '" + id.str() + "'");
    // Destroyed soon, outside of all callbacks.
    auto entry = std::make_unique<Kind>(parts_, std::move(id), std::move(quota),
                                        [this] { sweep_.enable_in(Duration::zero()); });
    return entries_.emplace(key, std::move(entry)).first->second.get();
  }

  // --- CatalogObserver

  template <class Work>
  void for_each_of(const KnownHost& host, const Work& work) const {
    for (const auto& [key, entry] : entries_) {
      if (entry->connection().owner() == host.greeting.host_id) work(*entry);
    }
  }
  template <class Work>
  void for_each_ring_of(const KnownHost& host, const StreamInfo& stream, const Work& work) const {
    const StreamId id{stream.id.name, stream.id.id, host.greeting.host};
    for (auto next = entries_.lower_bound(key_of(id));
         next != entries_.end() && next->second->id() == id; ++next) {
      if (next->second->connection().owner() == host.greeting.host_id) work(*next->second);
    }
  }

  void on_host_up(const KnownHost& host) override {
    for (const auto& [key, entry] : entries_) {
      OwnerConnection& connection = entry->connection();
      if (entry->id().host == host.greeting.host &&
          (!connection.owner() || *connection.owner() == host.greeting.host_id)) {
        connection.connect(host);
      }
    }
  }
  void on_host_down(const KnownHost& host, const Error& why) override {
    for_each_of(host, [&](Kind& entry) { entry.connection().on_owner_down(why); });
  }
  void on_host_clock(const KnownHost& host) override {
    for_each_of(host, [&](Kind& entry) { entry.on_owner_clock(host.greeting.clock); });
  }
  void on_remote_stream_added(const KnownHost& host, const StreamInfo& stream) override {
    for_each_ring_of(host, stream, [&](Kind& entry) { entry.on_stream_added(stream); });
  }
  // So that a program that was notified of the removal does not get the old ring afterwards. Not
  // when the host itself is down: its stream may still exist.
  void on_remote_stream_removed(const KnownHost& host, const StreamInfo& stream) override {
    if (host.is_down) return;
    for_each_ring_of(host, stream,
                     [&](Kind& entry) { entry.on_stream_removed(stream.incarnation); });
  }

  const ChannelParts& parts_;
  Catalog& catalog_;
  std::map<Key, std::unique_ptr<Kind>> entries_;
  EventSource sweep_;
};

}  // namespace dssm::daemon
