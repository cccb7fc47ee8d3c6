// SPDX-License-Identifier: Apache-2.0
#include "daemon/local/reply.hpp"

#include <utility>

#include "core/base/try.hpp"

namespace dssm::daemon {

Reply done() {
  Reply reply;
  reply.response.mutable_done();
  return reply;
}

std::vector<UniqueFd> take_descriptors(DescriptorQueue& queue) {
  if (queue.empty()) return {};
  std::vector<UniqueFd> taken = std::move(queue.front());
  queue.pop_front();
  return taken;
}

Result<OfferedFiles> offered_files(DescriptorQueue& queue, Role role) {
  std::vector<UniqueFd> offered = take_descriptors(queue);
  if (offered.size() < 3) {
    return Error{Errc::protocol, "the request comes without its descriptors (ring, bell, meta)"};
  }
  OfferedFiles files{std::move(offered[0]), std::move(offered[1]), std::move(offered[2]), {}};
  if (offered.size() > 3 && role == Role::writer) files.doorbell = std::move(offered[3]);
  return files;
}

Reply record_open(OpenTable& opens, const OpenEntry& entry) {
  Reply reply;
  proto::Opened& message = *reply.response.mutable_opened();
  message.set_handle(opens.add(entry));
  wire::to_message(entry.stream->id(), *message.mutable_stream()->mutable_id());
  wire::to_message(entry.stream->type(), *message.mutable_stream()->mutable_type());
  return reply;
}

Result<Reply> opened(OpenTable& opens, const OpenEntry& entry) {
  DSSM_TRY(opens.check_quota(*entry.client));
  std::vector<UniqueFd> descriptors = DSSM_TRY(entry.stream->descriptors_for(entry.role));
  Reply reply = record_open(opens, entry);
  reply.descriptors = std::move(descriptors);
  return reply;
}

}  // namespace dssm::daemon
