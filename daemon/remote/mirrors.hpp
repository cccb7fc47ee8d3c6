// SPDX-License-Identifier: Apache-2.0
//
// The mirrors of this dssmd.
#pragma once

#include "daemon/remote/channel_table.hpp"
#include "daemon/remote/mirror.hpp"
#include "daemon/remote/mirror_keeper.hpp"

namespace dssm::daemon {

class Mirrors final : public MirrorKeeper, private Mirror::Keeper, private CatalogObserver {
 public:
  // linger: how long a mirror stays after its last user left. parts and catalog outlive it.
  Mirrors(const ChannelParts& parts, Catalog& catalog, Duration linger);
  Mirrors(const Mirrors&) = delete;
  Mirrors& operator=(const Mirrors&) = delete;
  ~Mirrors();

  // This PC's clock was read anew.
  void on_clock();

  void set_linger(Duration linger) { linger_ = linger; }  // from the next time a reader leaves

  std::size_t size() const noexcept { return table_.size(); }

  void observe(MirrorKeeper::Observer* observer) override { observer_ = observer; }
  void open(const KnownHost& host, const StreamId& id, Then then) override;
  Result<std::shared_ptr<Stream>> adopt_untrusted(const StreamId& id, OfferedFiles files) override;
  std::shared_ptr<Stream> find(const StreamId& id) const override;
  bool describe(const StreamId& id, proto::Mirror& out) const override;

 private:
  void on_host_clock(const KnownHost& host) override;
  void on_remote_stream_removed(const KnownHost& host, const StreamInfo& stream) override;
  void on_ring_replaced(const Stream& old) override;
  void on_mirror_done() override { table_.sweep(); }

  Catalog& catalog_;
  MirrorKeeper::Observer* observer_ = nullptr;
  Duration linger_;
  ChannelTable<Mirror> table_;
};

}  // namespace dssm::daemon
