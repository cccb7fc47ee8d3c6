// SPDX-License-Identifier: Apache-2.0
#include "daemon/remote/mirrors.hpp"

#include <utility>

namespace dssm::daemon {

Mirrors::Mirrors(const ChannelParts& parts, Catalog& catalog, Duration linger)
    : catalog_(catalog),
      linger_(linger),
      table_(parts, catalog, [this, &parts](StreamId id, RingQuota room) {
        Mirror::Keeper& keeper = *this;
        return std::make_unique<Mirror>(parts, keeper, std::move(id), linger_, std::move(room));
      }) {
  catalog_.add_observer(*this);
}

Mirrors::~Mirrors() { catalog_.remove_observer(*this); }

void Mirrors::on_clock() {
  table_.for_each([](Mirror& mirror) { mirror.on_clock(); });
}

void Mirrors::on_host_clock(const KnownHost& host) {
  table_.for_each([&](Mirror& mirror) {
    if (mirror.channel().owner() == host.greeting.host_id) {
      mirror.on_owner_clock(host.greeting.clock);
    }
  });
}

// So that a program that was told of the removal does not get the stream's old ring afterwards.
void Mirrors::on_remote_stream_removed(const KnownHost& host, const StreamInfo& stream) {
  const wire::HostId& owner = host.greeting.host_id;
  if (!catalog_.find(owner)) return;  // it is the host that is gone, and its streams may be there
  Mirror* mirror = table_.find({stream.id.name, stream.id.id, host.greeting.host});
  if (mirror && mirror->channel().owner() == owner) mirror->on_stream_gone(stream.incarnation);
}

void Mirrors::open(const KnownHost& host, const StreamId& id, Then then) {
  const Result<Mirror*> mirror = table_.find_or_make(host, id);
  if (!mirror) return then(mirror.error());
  (*mirror)->open(std::move(then));
}

Result<std::shared_ptr<Stream>> Mirrors::adopt_untrusted(const StreamId& id, OfferedFiles files) {
  return table_.adopt(
      id, false, [&files](Mirror& mirror) { return mirror.adopt_untrusted(std::move(files)); });
}

std::shared_ptr<Stream> Mirrors::find(const StreamId& id) const {
  Mirror* mirror = table_.find(id);
  return mirror ? mirror->borrow() : nullptr;
}

bool Mirrors::describe(const StreamId& id, proto::Mirror& out) const {
  const Mirror* mirror = table_.find(id);
  if (!mirror) return false;
  mirror->describe(out);
  return true;
}

void Mirrors::on_ring_replaced(const Stream& old) {
  if (observer_) observer_->on_ring_replaced(old);
}

}  // namespace dssm::daemon
