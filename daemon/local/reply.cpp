// SPDX-License-Identifier: Apache-2.0
#include "daemon/local/reply.hpp"

#include <utility>

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

Reply noted_open(OpenTable& opens, const std::shared_ptr<const ClientIdentity>& client,
                 const std::shared_ptr<Stream>& stream, Role role, std::uint32_t tag) {
  Reply reply;
  local::Opened& message = *reply.response.mutable_opened();
  message.set_handle(opens.add({client, stream, role, tag}));
  wire::to_message(stream->id(), *message.mutable_id());
  wire::to_message(stream->type(), *message.mutable_type());
  return reply;
}

Result<Reply> opened(OpenTable& opens, const std::shared_ptr<const ClientIdentity>& client,
                     const std::shared_ptr<Stream>& stream, Role role, std::uint32_t tag) {
  if (Result<void> room = opens.check_room(*client); !room) return std::move(room).error();
  Result<std::vector<UniqueFd>> descriptors = stream->descriptors_for(role);
  if (!descriptors) return std::move(descriptors).error();
  Reply reply = noted_open(opens, client, stream, role, tag);
  reply.descriptors = *std::move(descriptors);
  return reply;
}

}  // namespace dssm::daemon
