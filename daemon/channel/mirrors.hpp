// SPDX-License-Identifier: Apache-2.0
//
// The mirrors of this dssmd: finds or makes the one for a stream, tells each what the catalog knows
// of its owner, and lets go of those that nobody uses. A mirror is known by the name, id and host's
// name of its stream, as programs write them.
#pragma once

#include <map>
#include <memory>
#include <string>
#include <tuple>

#include "daemon/channel/mirror.hpp"
#include "daemon/channel/mirror_keeper.hpp"

namespace dssm::daemon {

class Mirrors final : public MirrorKeeper, private CatalogObserver, private Mirror::Keeper {
 public:
  // linger: how long a mirror stays after its last user left. Both outlive it.
  Mirrors(const ChannelParts& parts, Catalog& catalog, Duration linger);
  Mirrors(const Mirrors&) = delete;
  Mirrors& operator=(const Mirrors&) = delete;
  ~Mirrors();

  std::size_t size() const noexcept { return mirrors_.size(); }

  void observe(MirrorKeeper::Observer* observer) override { observer_ = observer; }
  void open(const KnownHost& host, const StreamId& id, Then then) override;
  Result<std::shared_ptr<Stream>> adopt_untrusted(const StreamId& id, OfferedFiles files) override;
  std::shared_ptr<Stream> find(const StreamId& id) const override;
  bool describe(const StreamId& id, proto::Mirror& out) const override;

 private:
  using Key = std::tuple<std::string, std::int32_t, std::string>;  // name, id, host's name
  static Key key_of(const StreamId& id) { return {id.name, id.id, id.host}; }

  Mirror* mirror(const StreamId& id) const;
  Result<Mirror*> mirror_or_new(const StreamId& id);

  // CatalogObserver
  void on_host_up(const KnownHost& host) override;
  void on_host_down(const KnownHost& host, const Error& why) override;
  void on_remote_stream_added(const KnownHost& host, const StreamInfo& stream) override;
  // Mirror::Keeper
  void on_ring_replaced(const Stream& old) override;
  void on_mirror_done() override;

  const ChannelParts& parts_;
  Catalog& catalog_;
  const Duration linger_;
  MirrorKeeper::Observer* observer_ = nullptr;
  std::map<Key, std::unique_ptr<Mirror>> mirrors_;
  EventSource sweep_;  // destroys what is done, outside of its callbacks
};

}  // namespace dssm::daemon
