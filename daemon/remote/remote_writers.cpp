// SPDX-License-Identifier: Apache-2.0
#include "daemon/remote/remote_writers.hpp"

#include <utility>

namespace dssm::daemon {

RemoteWriters::RemoteWriters(const ChannelParts& parts, Catalog& catalog)
    : table_(parts, catalog, [this, &parts](StreamId id, RingQuota room) {
        RemoteWriter::Keeper& keeper = *this;
        return std::make_unique<RemoteWriter>(parts, keeper, std::move(id), std::move(room));
      }) {}

void RemoteWriters::open(const KnownHost& host, const StreamId& id, const CreatePlan* plan,
                         Then then) {
  const Result<RemoteWriter*> writer = table_.find_or_make(host, id);
  if (!writer) return then(writer.error());
  (*writer)->open(plan, std::move(then));
}

Result<std::shared_ptr<Stream>> RemoteWriters::adopt_untrusted(const StreamId& id,
                                                               OfferedFiles files) {
  // When somebody has opened the stream since, both rings are published, as two publishers'.
  return table_.adopt(id, true, [&files](RemoteWriter& writer) {
    return writer.adopt_untrusted(std::move(files));
  });
}

}  // namespace dssm::daemon
