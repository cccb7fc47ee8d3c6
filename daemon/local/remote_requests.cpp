// SPDX-License-Identifier: Apache-2.0
#include "daemon/local/remote_requests.hpp"

#include <utility>

#include "core/base/try.hpp"
#include "daemon/local/local_requests.hpp"

namespace dssm::daemon {
bool RemoteRequests::takes(const local::Request& request,
                           const std::function<bool(const StreamId&)>& own_knows) const {
  if (request.has_list_hosts() || request.has_ping_host() || request.has_open_clock_page()) {
    return true;
  }
  const proto::StreamId* subject = LocalRequests::subject(request);
  if (!subject) return false;
  const Result<StreamId> id = wire::stream_id_untrusted(*subject);
  if (!id) return false;  // refused like any other
  if (!id->host.empty()) return id->host != own_host_;
  // Without a host a stream is created here, and what is offered was.
  return !request.has_create() && !request.has_offer() && !own_knows(*id);
}

void RemoteRequests::handle_untrusted(const Client& client, const local::Request& request,
                                      DescriptorQueue& descriptors, Answer answer) {
  if (request.has_list_hosts()) return answer(list_hosts());
  if (request.has_open_clock_page()) return answer(open_clock_page());
  if (request.has_ping_host()) return ping(request.ping_host().host(), std::move(answer));
  const StreamId id = *wire::stream_id_untrusted(*LocalRequests::subject(request));
  switch (request.body_case()) {
    case local::Request::kCreate:
      return create(client, id, request.create(), std::move(answer));
    case local::Request::kOpen:
      return open(client, id, request.open(), std::move(answer));
    case local::Request::kOffer:
      return answer(offer(client, id, request.offer(), descriptors));
    default:
      return fleet_.forward(id, request,
                            [answer = std::move(answer)](Result<local::Response> response) {
                              if (!response) return answer(std::move(response).error());
                              answer(Reply{*std::move(response), {}});
                            });
  }
}

void RemoteRequests::create(const Client& client, const StreamId& id, const proto::Create& request,
                            Answer answer) {
  const Result<TypeInfo> type = wire::type_untrusted(request.type());
  if (!type) return answer(type.error());
  if (Result<void> quota = opens_.check_quota(*client); !quota) {
    return answer(std::move(quota).error());
  }
  const CreatePlan plan{*type, {request.depth(), Duration(request.cycle_ns())}};
  fleet_.open_writer(
      id, &plan,
      [this, client, tag = request.tag(), answer = std::move(answer)](Result<OpenedRing> writer) {
        if (!writer) return answer(std::move(writer).error());
        Result<Reply> reply = opened(opens_, {client, writer->stream, Role::writer, tag, false});
        if (reply) {
          reply->response.mutable_opened()->set_created(writer->created);
        }
        answer(std::move(reply));
      });
}

void RemoteRequests::open(const Client& client, const StreamId& id, const proto::Open& request,
                          Answer answer) {
  if (Result<void> quota = opens_.check_quota(*client); !quota) {
    return answer(std::move(quota).error());
  }
  const std::uint32_t tag = request.tag();
  const bool any_host = id.host.empty();
  if (request.for_writing()) {
    return fleet_.open_writer(
        id, nullptr,
        [this, client, tag, any_host, answer = std::move(answer)](Result<OpenedRing> writer) {
          if (!writer) return answer(std::move(writer).error());
          answer(opened(opens_, {client, writer->stream, Role::writer, tag, any_host}));
        });
  }
  fleet_.open_reader(id, [this, client, tag, any_host,
                          answer = std::move(answer)](Result<std::shared_ptr<Stream>> stream) {
    if (!stream) return answer(std::move(stream).error());
    Result<Reply> reply = opened(opens_, {client, *stream, Role::reader, tag, any_host});
    if (reply) reply->response.mutable_opened()->set_mirror(true);
    answer(std::move(reply));
  });
}

Result<Reply> RemoteRequests::offer(const Client& client, const StreamId& id,
                                    const local::Offer& request, DescriptorQueue& descriptors) {
  const Role role = request.for_writing() ? Role::writer : Role::reader;
  OfferedFiles files = DSSM_TRY(offered_files(descriptors, role));
  DSSM_TRY(opens_.check_quota(*client));
  const std::shared_ptr<Stream> stream =
      DSSM_TRY(fleet_.adopt_untrusted(id, role, std::move(files)));
  return record_open(opens_, {client, stream, role, request.tag(), request.any_host()});
}

void RemoteRequests::complete_list(Reply own, Answer answer) {
  // Shared, because functions that are handed around have to be copyable.
  const auto reply = std::make_shared<Reply>(std::move(own));
  fleet_.list([reply, answer = std::move(answer)](Result<std::vector<proto::Stream>> streams) {
    if (!streams) return answer(std::move(streams).error());
    proto::StreamList& list = *reply->response.mutable_stream_list();
    std::size_t bytes = list.ByteSizeLong();
    for (proto::Stream& stream : *streams) {
      bytes += stream.ByteSizeLong();
      if (bytes > kMaxListBytes) {
        bytes -= stream.ByteSizeLong();
        stream.mutable_type()->clear_fields();
        bytes += stream.ByteSizeLong();
      }
      if (bytes > kMaxListBytes) {
        return answer(Error{Errc::limit_exceeded,
                            "the list of all hosts' streams is longer than one message may be; ask "
                            "for those of this host only"});
      }
      *list.add_streams() = std::move(stream);
    }
    answer(std::move(*reply));
  });
}

Reply RemoteRequests::list_hosts() const {
  Reply reply;
  local::HostList& list = *reply.response.mutable_host_list();
  for (local::Host& host : fleet_.hosts()) *list.add_hosts() = std::move(host);
  return reply;
}

Result<Reply> RemoteRequests::open_clock_page() const {
  Reply reply;
  reply.response.mutable_clock_page();
  reply.descriptors.push_back(DSSM_TRY(fleet_.clock_page()));
  return reply;
}

void RemoteRequests::ping(const std::string& host, Answer answer) {
  Reply reply;
  if (host == own_host_) {  // this response shows that it is alive
    reply.response.mutable_round_trip();
    return answer(std::move(reply));
  }
  fleet_.ping(host, [answer = std::move(answer)](Result<local::RoundTrip> round_trip) {
    if (!round_trip) return answer(std::move(round_trip).error());
    Reply pong;
    *pong.response.mutable_round_trip() = *std::move(round_trip);
    answer(std::move(pong));
  });
}

}  // namespace dssm::daemon
