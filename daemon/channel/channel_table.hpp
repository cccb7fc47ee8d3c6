// SPDX-License-Identifier: Apache-2.0
//
// What this dssmd keeps for streams of other hosts, one per stream: mirrors in one table, remote
// writers in another. Finds or makes the entry for a stream, tells each what the catalog knows of
// its owner, and destroys those that are done. An entry is known by the name, id and host's name of
// its stream, as programs write them.
#pragma once

#include <functional>
#include <map>
#include <memory>
#include <string>
#include <tuple>
#include <utility>

#include "daemon/channel/owner_channel.hpp"

namespace dssm::daemon {

// Kept has
//   id()               with its owner's host
//   channel()          its OwnerChannel
//   on_stream_there()  the owner has such a stream, or a new ring of it
//   has_use()          whether there is a ring, or somebody who waits for one
//   done()             whether it may be destroyed
template <class Kept>
class ChannelTable final : private CatalogObserver {
 public:
  using Make = std::function<std::unique_ptr<Kept>(StreamId id, RingRoom room)>;

  // parts and catalog outlive it.
  ChannelTable(const ChannelParts& parts, Catalog& catalog, Make make)
      : parts_(parts),
        catalog_(catalog),
        make_(std::move(make)),
        sweep_(EventSource::timer(parts.loop, [this] {
          std::erase_if(entries_, [](const auto& entry) { return entry.second->done(); });
        })) {
    catalog_.add_observer(*this);
  }
  ChannelTable(const ChannelTable&) = delete;
  ChannelTable& operator=(const ChannelTable&) = delete;
  ~ChannelTable() { catalog_.remove_observer(*this); }

  std::size_t size() const noexcept { return entries_.size(); }

  // nullptr: none. Without a host in `id`: the only one of that name.
  Kept* find(const StreamId& id) const {
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

  // The entry for a stream of `host`, on its way there.
  //   fails  limit_exceeded, conflict
  Result<Kept*> find_or_make(const KnownHost& host, const StreamId& id) {
    const StreamId full{id.name, id.id, host.greeting.host};
    const Result<Kept*> found = find_or_make(full);
    if (!found) return found;
    OwnerChannel& channel = (*found)->channel();
    if (channel.owner() && *channel.owner() != host.greeting.host_id &&
        catalog_.find(*channel.owner())) {
      return Error{Errc::conflict, "stream '" + full.str() + "': two hosts are called '" +
                                       full.host +
                                       "', and the other one's is in use here; give each its own "
                                       "name (key name) and restart its dssmd"};
    }
    channel.connect(host);
    return found;
  }

  // The entry for a ring that `take` brings: a stream whose owner may not be known yet.
  Result<std::shared_ptr<Stream>> adopt(
      const StreamId& id, const std::function<Result<std::shared_ptr<Stream>>(Kept&)>& take) {
    const Result<Kept*> found = find_or_make(id);
    if (!found) return found.error();
    Kept& kept = **found;
    Result<std::shared_ptr<Stream>> stream = take(kept);
    if (!kept.has_use()) {
      entries_.erase(key_of(id));
    } else if (!kept.channel().owner()) {
      // Else it comes up later.
      if (const auto host = catalog_.find_host(id.host)) kept.channel().connect(**host);
    }
    return stream;
  }

  // Destroys soon, outside of all callbacks, what is done.
  void sweep() { sweep_.enable_in(Duration::zero()); }

 private:
  using Key = std::tuple<std::string, std::int32_t, std::string>;  // name, id, host's name
  static Key key_of(const StreamId& id) { return {id.name, id.id, id.host}; }

  Result<Kept*> find_or_make(const StreamId& id) {
    if (const auto found = entries_.find(key_of(id)); found != entries_.end()) {
      return found->second.get();
    }
    Result<RingRoom> room = parts_.registry.take_room();
    if (!room) return std::move(room).error().context("stream '" + id.str() + "'");
    return entries_.emplace(key_of(id), make_(id, *std::move(room))).first->second.get();
  }

  void on_host_up(const KnownHost& host) override {
    for (const auto& [key, kept] : entries_) {
      OwnerChannel& channel = kept->channel();
      if (kept->id().host == host.greeting.host &&
          (!channel.owner() || *channel.owner() == host.greeting.host_id)) {
        channel.connect(host);
      }
    }
  }
  void on_host_down(const KnownHost& host, const Error& why) override {
    for (const auto& [key, kept] : entries_) {
      if (kept->channel().owner() == host.greeting.host_id) kept->channel().on_owner_down(why);
    }
  }
  void on_remote_stream_added(const KnownHost& host, const StreamInfo& stream) override {
    const auto found = entries_.find({stream.id.name, stream.id.id, host.greeting.host});
    if (found == entries_.end()) return;
    if (found->second->channel().owner() == host.greeting.host_id) found->second->on_stream_there();
  }

  const ChannelParts& parts_;
  Catalog& catalog_;
  const Make make_;
  std::map<Key, std::unique_ptr<Kept>> entries_;
  EventSource sweep_;
};

}  // namespace dssm::daemon
