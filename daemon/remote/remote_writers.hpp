// SPDX-License-Identifier: Apache-2.0
//
// The remote writers of this dssmd.
#pragma once

#include "daemon/remote/channel_table.hpp"
#include "daemon/remote/remote_writer.hpp"
#include "daemon/remote/remote_writer_keeper.hpp"

namespace dssm::daemon {

class RemoteWriters final : public RemoteWriterKeeper, private RemoteWriter::Keeper {
 public:
  // parts and catalog outlive it.
  RemoteWriters(const ChannelParts& parts, Catalog& catalog);
  RemoteWriters(const RemoteWriters&) = delete;
  RemoteWriters& operator=(const RemoteWriters&) = delete;

  std::size_t size() const noexcept { return table_.size(); }

  void open(const KnownHost& host, const StreamId& id, const CreatePlan* plan, Then then) override;
  Result<std::shared_ptr<Stream>> adopt_untrusted(const StreamId& id, OfferedFiles files) override;

 private:
  void on_remote_writer_done() override { table_.sweep(); }

  ChannelTable<RemoteWriter> table_;
};

}  // namespace dssm::daemon
