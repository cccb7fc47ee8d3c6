// SPDX-License-Identifier: Apache-2.0
//
// Serves the requests of catalog.proto about the streams of this host: for its programs
// (LocalService) and for other hosts (DataCommunicator) alike. Both protocols carry these messages
// in fields of the same names, so one template serves local::Request and net::Frame.
//
// Watch, which has state, and what a created or opened stream means to a connection (descriptors,
// or a channel) belong to the two callers.
#pragma once

#include <cstddef>
#include <cstdint>
#include <dssm/result.hpp>
#include <memory>
#include <string>

#include "catalog.pb.h"
#include "common.pb.h"
#include "daemon/streams/node_table.hpp"
#include "daemon/streams/open_table.hpp"
#include "daemon/streams/registry.hpp"
#include "daemon/streams/rights.hpp"

namespace dssm::daemon {

// The stream as it is at this moment, with how many programs and channels use it.
void describe(const Stream& stream, const OpenTable& opens, proto::Stream& out,
              bool with_fields = true);

// The events that Watch is answered with, to programs and hosts alike.
proto::StreamEvent added_event(const Stream& stream, const OpenTable& opens,
                               bool property_set = false);
proto::StreamEvent removed_event(const StreamId& id, std::uint64_t incarnation = 0);

// Stateless.
class CatalogRequests {
 public:
  // With more fields of types in all, lists leave them out: others would wait too long.
  static constexpr std::size_t kMaxListedFields = 1024;

  // max_list_bytes: of a StreamList that fits into a frame. Both references outlive this.
  CatalogRequests(Registry& registry, const OpenTable& opens, std::size_t max_list_bytes)
      : registry_(registry), opens_(opens), max_list_bytes_(max_list_bytes) {}

  // Serves List, ListNodes, Info, Remove, SetProperty, GetProperty and Describe, and fills in the
  // response's body.
  //   Request   local::Request or net::Frame; Response: local::Response or net::Frame
  //   channel   the stream of the channel that the request came on, for properties; nullptr: the
  //             request names its stream
  //   account   of the client, which is charged for a property
  //   fails     with the failure that is the response; protocol: any other request
  template <class Request, class Response>
  Result<void> serve_untrusted(const Request& request, Response& response,
                               const std::string& account, const StreamId* channel = nullptr);

  // The processes that have streams open here or, with `of_channels`, over channels to here.
  NodeTable nodes(bool of_channels = true) const;

  // For Open and Create.
  Result<std::shared_ptr<Stream>> find_untrusted(const proto::StreamId& id) const;
  //   who     asks; has the right to create the stream, or to write to the existing one
  //   rights  decide whether `who` may replace an existing one
  Result<OpenedRing> create_untrusted(const proto::Create& request, const Identity& who,
                                      const Rights& rights);

 private:
  Result<void> list(proto::StreamList& out) const;
  Result<void> list_nodes(proto::NodeList& out) const;
  Result<std::string> property_of(const StreamId& id) const;
  Result<void> check_unused(const Stream& stream) const;

  Registry& registry_;
  const OpenTable& opens_;
  const std::size_t max_list_bytes_;
};

// The stream that `request` (local::Request or net::Frame) names; nullptr: none.
template <class Request>
const proto::StreamId* subject(const Request& request) noexcept {
  switch (request.body_case()) {
    case Request::kOpen:
      return &request.open().id();
    case Request::kCreate:
      return &request.create().id();
    case Request::kInfo:
      return &request.info().id();
    case Request::kRemove:
      return &request.remove().id();
    case Request::kSetProperty:
      return &request.set_property().id();
    case Request::kGetProperty:
      return &request.get_property().id();
    case Request::kDescribe:
      return &request.describe().id();
    default:
      return nullptr;
  }
}

// For requests that dssmd of `host` does not know.
Error unknown_request(const std::string& host);

}  // namespace dssm::daemon
