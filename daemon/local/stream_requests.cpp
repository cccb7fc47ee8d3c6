// SPDX-License-Identifier: Apache-2.0
#include "daemon/local/stream_requests.hpp"

#include <unistd.h>

#include <utility>

#include "core/wire/local_protocol.hpp"
#include "daemon/streams/description.hpp"

namespace dssm::daemon {

Result<Reply> StreamRequests::handle_untrusted(const Client& client, const local::Request& request,
                                               DescriptorQueue& descriptors) {
  switch (request.body_case()) {
    case local::Request::kCreate:
      return create(client, request.create());
    case local::Request::kOpen:
      return open(client, request.open());
    case local::Request::kOffer:
      return offer(client, request.offer(), descriptors);
    case local::Request::kClose:
      return close(client, request.close());
    case local::Request::kRemove:
      return remove(request.remove());
    case local::Request::kList:
      return list();
    case local::Request::kInfo:
      return info(request.info());
    case local::Request::kSetProperty:
      return set_property(request.set_property());
    case local::Request::kGetProperty:
      return get_property(request.get_property());
    case local::Request::kOpenClock:
      return open_clock(request.open_clock(), descriptors);
    case local::Request::kListOpens:
      return list_opens();
    case local::Request::kGetDaemon:
      return get_daemon();
    case local::Request::kOpenClockPage:
    case local::Request::kHello:
    case local::Request::kWatch:
    case local::Request::kListClients:
    case local::Request::kListHosts:
    case local::Request::kPingHost:
    case local::Request::BODY_NOT_SET:
      break;
  }
  return Error{Errc::protocol,
               "this dssmd (" DSSM_VERSION
               ") does not know such a request; install the same version of DSSM on both sides"};
}

const proto::StreamId* StreamRequests::subject(const local::Request& request) noexcept {
  switch (request.body_case()) {
    case local::Request::kCreate:
      return &request.create().id();
    case local::Request::kOpen:
      return &request.open().id();
    case local::Request::kOffer:
      return &request.offer().id();
    case local::Request::kRemove:
      return &request.remove().id();
    case local::Request::kInfo:
      return &request.info().id();
    case local::Request::kSetProperty:
      return &request.set_property().id();
    case local::Request::kGetProperty:
      return &request.get_property().id();
    default:
      return nullptr;
  }
}

Result<std::shared_ptr<Stream>> StreamRequests::find_untrusted(const proto::StreamId& id) const {
  const Result<StreamId> checked = wire::stream_id_untrusted(id);
  if (!checked) return checked.error();
  return registry_.find(*checked);
}

Result<Reply> StreamRequests::create(const Client& client, const local::Create& request) {
  const Result<StreamId> id = wire::stream_id_untrusted(request.id());
  if (!id) return id.error();
  const Result<TypeInfo> type = wire::type_untrusted(request.type());
  if (!type) return type.error();
  if (Result<void> room = opens_.check_quota(*client); !room) return std::move(room).error();
  const Result<Registry::Created> created =
      registry_.create(*id, *type, {request.depth(), Duration(request.cycle_ns())}, client->pid);
  if (!created) return created.error();
  Result<Reply> reply =
      opened(opens_, {client, created->stream, Role::writer, request.tag(), id->host.empty()});
  if (reply) {
    reply->response.mutable_opened()->set_created(created->created);
  } else if (created->created) {
    // Nobody would know of it, and nothing was written to it: as if it had never been.
    static_cast<void>(registry_.remove(created->stream->id()));
  }
  return reply;
}

Result<Reply> StreamRequests::open(const Client& client, const local::Open& request) {
  const Result<std::shared_ptr<Stream>> stream = find_untrusted(request.id());
  if (!stream) return stream.error();
  const Role role = request.for_writing() ? Role::writer : Role::reader;
  return opened(opens_, {client, *stream, role, request.tag(), request.id().host().empty()});
}

Result<Reply> StreamRequests::offer(const Client& client, const local::Offer& request,
                                    DescriptorQueue& descriptors) {
  const Role role = request.for_writing() ? Role::writer : Role::reader;
  Result<OfferedFiles> files = offered_files(descriptors, role);
  if (!files) return std::move(files).error();
  const Result<StreamId> id = wire::stream_id_untrusted(request.id());
  if (!id) return id.error();
  if (Result<void> room = opens_.check_quota(*client); !room) return std::move(room).error();
  const Result<std::shared_ptr<Stream>> stream = registry_.adopt_untrusted(*id, *std::move(files));
  if (!stream) return stream.error();
  return noted_open(opens_, {client, *stream, role, request.tag(), request.any_host()});
}

Result<Reply> StreamRequests::close(const Client& client, const local::Close& request) {
  if (Result<void> closed = opens_.remove(client->number, request.handle()); !closed) {
    return std::move(closed).error();
  }
  return done();
}

Result<Reply> StreamRequests::remove(const local::Remove& request) {
  const Result<std::shared_ptr<Stream>> stream = find_untrusted(request.id());
  if (!stream) return stream.error();
  if (Result<void> removed = registry_.remove((*stream)->id()); !removed) {
    return std::move(removed).error();
  }
  return done();
}

Result<Reply> StreamRequests::list() {
  Reply reply;
  describe_all(registry_, opens_, kMaxListBytes, *reply.response.mutable_stream_list());
  return reply;
}

Result<Reply> StreamRequests::info(const local::Info& request) {
  const Result<std::shared_ptr<Stream>> stream = find_untrusted(request.id());
  if (!stream) return stream.error();
  Reply reply;
  describe_with_users(**stream, opens_, *reply.response.mutable_stream_list()->add_streams());
  return reply;
}

Result<Reply> StreamRequests::set_property(const local::SetProperty& request) {
  const Result<StreamId> id = wire::stream_id_untrusted(request.id());
  if (!id) return id.error();
  if (Result<void> set = registry_.set_property(*id, request.property()); !set) {
    return std::move(set).error();
  }
  return done();
}

Result<Reply> StreamRequests::get_property(const local::GetProperty& request) {
  const Result<std::shared_ptr<Stream>> stream = find_untrusted(request.id());
  if (!stream) return stream.error();
  Result<std::string> property = property_of(**stream);
  if (!property) return std::move(property).error();
  Reply reply;
  reply.response.mutable_property()->set_property(*std::move(property));
  return reply;
}

Result<Reply> StreamRequests::open_clock(const local::OpenClock& request,
                                         DescriptorQueue& descriptors) {
  if (request.offered()) {
    std::vector<UniqueFd> offered = take_descriptors(descriptors);
    if (offered.empty()) {
      return Error{Errc::protocol, "the request comes without its descriptor (clock)"};
    }
    if (!clock_.has_one()) {
      Result<void> adopted = clock_.adopt_untrusted(std::move(offered[0]));
      if (!adopted) return std::move(adopted).error();
    }
  }
  Result<UniqueFd> clock = clock_.get();
  if (!clock) return std::move(clock).error();
  Reply reply;
  reply.response.mutable_clock();
  reply.descriptors.push_back(*std::move(clock));
  return reply;
}

Result<Reply> StreamRequests::list_opens() {
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

Result<Reply> StreamRequests::get_daemon() {
  Reply reply;
  local::Daemon& daemon = *reply.response.mutable_daemon();
  daemon.set_host(registry_.host());
  daemon.set_version(DSSM_VERSION);
  daemon.set_pid(::getpid());
  daemon.set_streams(registry_.streams().size());
  daemon.set_memory_bytes(registry_.budget().used());
  daemon.set_memory_limit_bytes(registry_.budget().limit());
  daemon.mutable_mdns()->set_phase("off");  // unless there is a fleet that knows more
  return reply;
}

}  // namespace dssm::daemon
