// SPDX-License-Identifier: Apache-2.0
#include "daemon/streams/catalog_requests.hpp"

#include <fmt/format.h>

#include <utility>

#include "core/base/try.hpp"
#include "core/wire/messages.hpp"
#include "daemon/streams/description.hpp"
#include "local.pb.h"
#include "network.pb.h"

namespace dssm::daemon {

Error unknown_request(const std::string& host) {
  return {Errc::protocol, fmt::format("dssmd of host '{}' ({}) does not know this request; install "
                                      "the same version of DSSM on both sides",
                                      host, DSSM_VERSION)};
}

template <class Request, class Response>
Result<void> CatalogRequests::serve_untrusted(const Request& request, Response& response,
                                              const StreamId* channel) {
  if (request.has_list()) return list(*response.mutable_stream_list());
  const proto::StreamId* named = subject(request);
  if (!named) return unknown_request(registry_.host());
  const StreamId id = channel ? *channel : DSSM_TRY(wire::stream_id_untrusted(*named));
  switch (request.body_case()) {
    case Request::kInfo: {
      const std::shared_ptr<Stream> stream = DSSM_TRY(registry_.find(id));
      describe_with_users(*stream, opens_, *response.mutable_stream_list()->add_streams());
      return {};
    }
    case Request::kRemove:
      DSSM_TRY(registry_.remove(id));
      response.mutable_done();
      return {};
    case Request::kSetProperty:
      DSSM_TRY(registry_.set_property(id, request.set_property().property()));
      response.mutable_done();
      return {};
    case Request::kGetProperty: {
      const std::shared_ptr<Stream> stream = DSSM_TRY(registry_.find(id));
      response.mutable_property()->set_property(DSSM_TRY(property_of(*stream)));
      return {};
    }
    default:
      return unknown_request(registry_.host());
  }
}

template Result<void> CatalogRequests::serve_untrusted(const local::Request&, local::Response&,
                                                       const StreamId*);
template Result<void> CatalogRequests::serve_untrusted(const net::Frame&, net::Frame&,
                                                       const StreamId*);

Result<std::shared_ptr<Stream>> CatalogRequests::find_untrusted(const proto::StreamId& id) const {
  return registry_.find(DSSM_TRY(wire::stream_id_untrusted(id)));
}

Result<Registry::Created> CatalogRequests::create_untrusted(const proto::Create& request,
                                                            std::int32_t creator_pid) {
  const StreamId id = DSSM_TRY(wire::stream_id_untrusted(request.id()));
  const TypeInfo type = DSSM_TRY(wire::type_untrusted(request.type()));
  return registry_.create(id, type, {request.depth(), Duration(request.cycle_ns())}, creator_pid);
}

Result<void> CatalogRequests::list(proto::StreamList& out) const {
  describe_all(registry_, opens_, max_list_bytes_, out);
  if (out.ByteSizeLong() <= max_list_bytes_) return {};
  return Error{Errc::limit_exceeded,
               fmt::format("the list of the {} streams of host '{}' is longer than one message may "
                           "be; Watch reports them one by one",
                           registry_.streams().size(), registry_.host())};
}

}  // namespace dssm::daemon
