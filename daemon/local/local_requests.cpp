// SPDX-License-Identifier: Apache-2.0
#include "daemon/local/local_requests.hpp"

#include <unistd.h>

#include <utility>

#include "core/base/try.hpp"
#include "core/wire/local_protocol.hpp"

namespace dssm::daemon {

Result<Reply> LocalRequests::serve_untrusted(const Client& client, const local::Request& request,
                                             DescriptorQueue& descriptors) {
  switch (request.body_case()) {
    case local::Request::kCreate:
      return create(client, request.create());
    case local::Request::kOpen:
      return open(client, request.open());
    case local::Request::kOffer:
      return offer(client, request.offer(), descriptors);
    case local::Request::kClose:
      DSSM_TRY(opens_.remove(client->number, request.close().handle()));
      return done();
    case local::Request::kOpenClock:
      return open_clock(request.open_clock(), descriptors);
    case local::Request::kListOpens:
      return list_opens();
    case local::Request::kGetDaemon:
      return get_daemon();
    default:
      break;
  }
  Reply reply;
  DSSM_TRY(catalog_.serve_untrusted(request, reply.response));
  return reply;
}

Result<Reply> LocalRequests::create(const Client& client, const proto::Create& request) {
  DSSM_TRY(opens_.check_quota(*client));
  const Registry::Created created = DSSM_TRY(catalog_.create_untrusted(request, client->pid));
  Result<Reply> reply = opened(
      opens_, {client, created.stream, Role::writer, request.tag(), request.id().host().empty()});
  if (reply) {
    reply->response.mutable_opened()->set_created(created.created);
  } else if (created.created) {
    // No program knows of it yet, and nothing is written to it.
    static_cast<void>(registry_.remove(created.stream->id()));
  }
  return reply;
}

Result<Reply> LocalRequests::open(const Client& client, const proto::Open& request) {
  const std::shared_ptr<Stream> stream = DSSM_TRY(catalog_.find_untrusted(request.id()));
  const Role role = request.for_writing() ? Role::writer : Role::reader;
  return opened(opens_, {client, stream, role, request.tag(), request.id().host().empty()});
}

Result<Reply> LocalRequests::offer(const Client& client, const local::Offer& request,
                                   DescriptorQueue& descriptors) {
  const Role role = request.for_writing() ? Role::writer : Role::reader;
  OfferedFiles files = DSSM_TRY(offered_files(descriptors, role));
  const StreamId id = DSSM_TRY(wire::stream_id_untrusted(request.id()));
  DSSM_TRY(opens_.check_quota(*client));
  const std::shared_ptr<Stream> stream = DSSM_TRY(registry_.adopt_untrusted(id, std::move(files)));
  return record_open(opens_, {client, stream, role, request.tag(), request.any_host()});
}

Result<Reply> LocalRequests::open_clock(const local::OpenClock& request,
                                        DescriptorQueue& descriptors) {
  if (request.offered()) {
    std::vector<UniqueFd> offered = take_descriptors(descriptors);
    if (offered.empty()) {
      return Error{Errc::protocol, "the request comes without its descriptor (clock)"};
    }
    if (!clock_.has_one()) DSSM_TRY(clock_.adopt_untrusted(std::move(offered[0])));
  }
  Reply reply;
  reply.response.mutable_clock();
  reply.descriptors.push_back(DSSM_TRY(clock_.get()));
  return reply;
}

Reply LocalRequests::list_opens() const {
  Reply reply;
  local::OpenList& list = *reply.response.mutable_open_list();
  for (const auto& [number, open] : opens_.entries()) {
    if (open.stream->removed()) continue;
    local::OpenEntry& entry = *list.add_opens();
    wire::to_message(open.stream->id(), *entry.mutable_id());
    entry.set_creator_pid(open.stream->creator_pid());
    entry.set_opener_pid(open.client->pid);
    entry.set_tag(open.tag);
    entry.set_for_writing(open.role == Role::writer);
  }
  return reply;
}

Reply LocalRequests::get_daemon() const {
  Reply reply;
  local::Daemon& daemon = *reply.response.mutable_daemon();
  daemon.set_host(registry_.host());
  daemon.set_version(DSSM_VERSION);
  daemon.set_pid(::getpid());
  daemon.set_streams(registry_.streams().size());
  daemon.set_memory_bytes(registry_.budget().used());
  daemon.set_memory_limit_bytes(registry_.budget().limit());
  return reply;
}

}  // namespace dssm::daemon
