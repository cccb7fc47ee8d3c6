// SPDX-License-Identifier: Apache-2.0
#include "daemon/channel/mirrors.hpp"

#include <utility>

namespace dssm::daemon {

Mirrors::Mirrors(const ChannelParts& parts, Catalog& catalog, Duration linger)
    : parts_(parts),
      catalog_(catalog),
      linger_(linger),
      sweep_(EventSource::timer(parts.loop, [this] {
        std::erase_if(mirrors_, [](const auto& entry) { return entry.second->done(); });
      })) {
  catalog_.add_observer(*this);
}

Mirrors::~Mirrors() { catalog_.remove_observer(*this); }

Mirror* Mirrors::mirror(const StreamId& id) const {
  const auto found = mirrors_.find(key_of(id));
  return found == mirrors_.end() ? nullptr : found->second.get();
}

Result<Mirror*> Mirrors::mirror_or_new(const StreamId& id) {
  if (Mirror* there = mirror(id)) return there;
  Result<RingRoom> room = parts_.registry.take_room();
  if (!room) return std::move(room).error().context("mirror '" + id.str() + "'");
  std::unique_ptr<Mirror> made(new Mirror(parts_, *this, id, linger_, *std::move(room)));
  return mirrors_.emplace(key_of(id), std::move(made)).first->second.get();
}

void Mirrors::open(const KnownHost& host, const StreamId& id, Then then) {
  const StreamId full{id.name, id.id, host.greeting.host};
  const Result<Mirror*> found = mirror_or_new(full);
  if (!found) return then(found.error());
  Mirror& one = **found;
  if (one.channel().owner() && *one.channel().owner() != host.greeting.host_id &&
      catalog_.find(*one.channel().owner())) {
    return then(Error{Errc::conflict, "stream '" + full.str() + "': two hosts are called '" +
                                          full.host +
                                          "', and the mirror here is that of the other one; give "
                                          "each its own name (key name) and restart its dssmd"});
  }
  one.channel().connect(host);
  one.open(std::move(then));
}

Result<std::shared_ptr<Stream>> Mirrors::adopt_untrusted(const StreamId& id, OfferedFiles files) {
  const Result<Mirror*> found = mirror_or_new(id);
  if (!found) return found.error();
  Result<std::shared_ptr<Stream>> stream = (*found)->adopt_untrusted(std::move(files));
  if (!(*found)->has_use()) mirrors_.erase(key_of(id));
  if (!stream) return stream;
  // Else it comes up later, or not at all.
  if (const Result<const KnownHost*> host = catalog_.find_host(id.host);
      host && !(*found)->channel().owner()) {
    (*found)->channel().connect(**host);
  }
  return stream;
}

std::shared_ptr<Stream> Mirrors::find(const StreamId& id) const {
  if (!id.host.empty()) {
    Mirror* one = mirror(id);
    return one ? one->borrow() : nullptr;
  }
  const auto first = mirrors_.lower_bound({id.name, id.id, ""});
  if (first == mirrors_.end()) return nullptr;
  const auto is_named = [&](const auto& entry) {
    return std::get<0>(entry.first) == id.name && std::get<1>(entry.first) == id.id;
  };
  if (!is_named(*first)) return nullptr;
  if (const auto next = std::next(first); next != mirrors_.end() && is_named(*next)) return nullptr;
  return first->second->borrow();
}

bool Mirrors::describe(const StreamId& id, proto::Mirror& out) const {
  const Mirror* one = mirror(id);
  if (!one) return false;
  one->describe(out);
  return true;
}

// --- the catalog -----------------------------------------------------------------------------

void Mirrors::on_host_up(const KnownHost& host) {
  for (const auto& [key, one] : mirrors_) {
    if (one->id().host != host.greeting.host) continue;
    if (!one->channel().owner() || *one->channel().owner() == host.greeting.host_id)
      one->channel().connect(host);
  }
}

void Mirrors::on_host_down(const KnownHost& host, const Error& why) {
  for (const auto& [key, one] : mirrors_) {
    if (one->channel().owner() == host.greeting.host_id) one->channel().on_owner_down(why);
  }
}

void Mirrors::on_remote_stream_added(const KnownHost& host, const StreamInfo& stream) {
  Mirror* one = mirror({stream.id.name, stream.id.id, host.greeting.host});
  if (one && one->channel().owner() == host.greeting.host_id) one->on_stream_there();
}

// --- the mirrors -----------------------------------------------------------------------------

void Mirrors::on_ring_replaced(const Stream& old) {
  if (observer_) observer_->on_ring_replaced(old);
}

void Mirrors::on_mirror_done() { sweep_.enable_in(Duration::zero()); }

}  // namespace dssm::daemon
