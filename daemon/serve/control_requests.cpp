// SPDX-License-Identifier: Apache-2.0
#include "daemon/serve/control_requests.hpp"

#include <utility>

#include "core/wire/network_protocol.hpp"
#include "daemon/streams/description.hpp"

namespace dssm::daemon {
namespace {

// What receivers take of a frame, less what frames a list.
constexpr std::size_t kMaxPlainListBytes = wire::kMaxPlainBytes - (4U << 10);

}  // namespace

bool ControlRequests::is_control(const net::Frame& request) noexcept {
  switch (request.body_case()) {
    case net::Frame::kList:
    case net::Frame::kWatch:
    case net::Frame::kInfo:
    case net::Frame::kRemove:
      return true;
    case net::Frame::kSetProperty:
      return request.set_property().has_id();
    case net::Frame::kGetProperty:
      return request.get_property().has_id();
    default:
      return false;
  }
}

Result<void> ControlRequests::serve_untrusted(const net::Frame& request, net::Frame& answer) {
  switch (request.body_case()) {
    case net::Frame::kList:
      return list(answer);
    case net::Frame::kInfo:
      return info(request.info(), answer);
    case net::Frame::kRemove:
      return remove(request.remove(), answer);
    case net::Frame::kSetProperty:
      return set_property(request.set_property(), answer);
    case net::Frame::kGetProperty:
      return get_property(request.get_property(), answer);
    default:
      break;
  }
  return Error{
      Errc::protocol,
      "dssmd of host '" + registry_.host() +
          "' (" DSSM_VERSION
          ") does not know such a request; install the same version of DSSM on both sides"};
}

Result<std::shared_ptr<Stream>> ControlRequests::find_untrusted(const proto::StreamId& id) const {
  const Result<StreamId> checked = wire::stream_id_untrusted(id);
  if (!checked) return checked.error();
  return registry_.find(*checked);
}

Result<void> ControlRequests::list(net::Frame& answer) const {
  proto::StreamList& list = *answer.mutable_stream_list();
  describe_all(registry_, opens_, kMaxPlainListBytes, list);
  if (list.ByteSizeLong() <= kMaxPlainListBytes) return {};
  return Error{Errc::limit_exceeded,
               "the list of the " + std::to_string(registry_.streams().size()) +
                   " streams of host '" + registry_.host() +
                   "' is longer than one message may be; Watch tells them one by one"};
}

Result<void> ControlRequests::info(const net::Info& request, net::Frame& answer) const {
  const Result<std::shared_ptr<Stream>> stream = find_untrusted(request.id());
  if (!stream) return stream.error();
  describe_with_users(**stream, opens_, *answer.mutable_stream_list()->add_streams());
  return {};
}

Result<void> ControlRequests::remove(const net::Remove& request, net::Frame& answer) {
  const Result<std::shared_ptr<Stream>> stream = find_untrusted(request.id());
  if (!stream) return stream.error();
  if (Result<void> removed = registry_.remove((*stream)->id()); !removed) return removed;
  answer.mutable_done();
  return {};
}

Result<void> ControlRequests::set_property(const net::SetProperty& request, net::Frame& answer) {
  const Result<StreamId> id = wire::stream_id_untrusted(request.id());
  if (!id) return id.error();
  if (Result<void> set = registry_.set_property(*id, request.property()); !set) return set;
  answer.mutable_done();
  return {};
}

Result<void> ControlRequests::get_property(const net::GetProperty& request,
                                           net::Frame& answer) const {
  const Result<std::shared_ptr<Stream>> stream = find_untrusted(request.id());
  if (!stream) return stream.error();
  Result<std::string> property = property_of(**stream);
  if (!property) return std::move(property).error();
  answer.mutable_property()->set_property(*std::move(property));
  return {};
}

}  // namespace dssm::daemon
