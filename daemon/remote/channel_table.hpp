// SPDX-License-Identifier: Apache-2.0
//
// What this dssmd keeps for streams of other hosts, one per stream: mirrors in one table, remote
// writers in another. Finds or makes the entry for a stream, tells each what the catalog knows of
// its owner, and destroys those that are done. An entry is known by the name, id and host's name of
// its stream, as programs write them; where several rings of one stream may be in use, further ones
// are numbered.
#pragma once

#include <functional>
#include <map>
#include <memory>
#include <string>
#include <tuple>
#include <utility>

#include "daemon/remote/owner_connection.hpp"

namespace dssm::daemon {

// Kept has
//   id()               with its owner's host
//   channel()          its OwnerConnection
//   on_stream_there()  the owner has such a stream, or a new ring of it
//   has_use()          whether there is a ring, or somebody who waits for one
//   done()             whether it may be destroyed
template <class Kept>
class ChannelTable final : private CatalogObserver {
 public:
  using Make = std::function<std::unique_ptr<Kept>(StreamId id, RingQuota room)>;

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
    Result<Kept*> found = find_or_make(key_of(full));
    if (!found) return found;
    OwnerConnection& channel = (*found)->channel();
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

  // Gives a ring that a program kept to the entry that has it already, or to a new one: `take`
  // does, and fails with conflict when the entry has another ring. The owner may not be known yet.
  //   side_by_side  several rings of one stream may be in use; else only the first entry is asked
  //   fails         as take; limit_exceeded
  Result<std::shared_ptr<Stream>> adopt(
      const StreamId& id, bool side_by_side,
      const std::function<Result<std::shared_ptr<Stream>>(Kept&)>& take) {
    Key key = key_of(id);
    for (;; ++std::get<3>(key)) {
      const Result<Kept*> found = find_or_make(key);
      if (!found) return found.error();
      Kept& kept = **found;
      Result<std::shared_ptr<Stream>> stream = take(kept);
      if (side_by_side && !stream && stream.error().code == Errc::conflict) continue;
      if (!kept.has_use()) {
        entries_.erase(key);
      } else if (!kept.channel().owner()) {
        // Else it comes up later.
        if (const auto host = catalog_.find_host(id.host)) kept.channel().connect(**host);
      }
      return stream;
    }
  }

  template <class Work>
  void for_each(const Work& work) const {
    for (const auto& [key, kept] : entries_) work(*kept);
  }

  // Destroys soon, outside of all callbacks, what is done.
  void sweep() { sweep_.enable_in(Duration::zero()); }

 private:
  // Name, id, host's name; 0, or the number of a further ring.
  using Key = std::tuple<std::string, std::int32_t, std::string, std::uint64_t>;
  static Key key_of(const StreamId& id) { return {id.name, id.id, id.host, 0}; }

  Result<Kept*> find_or_make(const Key& key) {
    if (const auto found = entries_.find(key); found != entries_.end()) return found->second.get();
    const StreamId id{std::get<0>(key), std::get<1>(key), std::get<2>(key)};
    Result<RingQuota> room = parts_.registry.acquire_quota();
    if (!room) return std::move(room).error().context("stream '" + id.str() + "'");
    return entries_.emplace(key, make_(id, *std::move(room))).first->second.get();
  }

  void on_host_up(const KnownHost& host) override {
    for (const auto& [key, kept] : entries_) {
      OwnerConnection& channel = kept->channel();
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
    const StreamId id{stream.id.name, stream.id.id, host.greeting.host};
    for (auto next = entries_.lower_bound(key_of(id));
         next != entries_.end() && next->second->id() == id; ++next) {
      Kept& kept = *next->second;
      if (kept.channel().owner() == host.greeting.host_id) kept.on_stream_there();
    }
  }

  const ChannelParts& parts_;
  Catalog& catalog_;
  const Make make_;
  std::map<Key, std::unique_ptr<Kept>> entries_;
  EventSource sweep_;
};

}  // namespace dssm::daemon
