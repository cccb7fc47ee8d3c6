// SPDX-License-Identifier: Apache-2.0
//
// Serves what programs ask about this host's streams: the requests of catalog.proto through
// CatalogRequests, and here what comes with descriptors or is about this dssmd. No sockets and no
// events; LocalService decides when a request is served.
#pragma once

#include <dssm/result.hpp>
#include <memory>

#include "daemon/local/reply.hpp"
#include "daemon/streams/catalog_requests.hpp"
#include "daemon/streams/open_table.hpp"
#include "daemon/streams/playback_clock_owner.hpp"
#include "daemon/streams/registry.hpp"
#include "local.pb.h"

namespace dssm::daemon {

class LocalRequests {
 public:
  LocalRequests(Registry& registry, OpenTable& opens, PlaybackClockOwner& clock)
      : registry_(registry),
        opens_(opens),
        clock_(clock),
        catalog_(registry, opens, kMaxListBytes) {}

  using Client = std::shared_ptr<const ClientIdentity>;

  //   fails  with the failure that is the response
  Result<Reply> serve_untrusted(const Client& client, const local::Request& request,
                                DescriptorQueue& descriptors);

  // The stream that `request` names; nullptr: none.
  static const proto::StreamId* subject(const local::Request& request) noexcept {
    return request.has_offer() ? &request.offer().id() : daemon::subject(request);
  }

 private:
  Result<Reply> create(const Client& client, const proto::Create& request);
  Result<Reply> open(const Client& client, const proto::Open& request);
  Result<Reply> offer(const Client& client, const local::Offer& request,
                      DescriptorQueue& descriptors);
  Result<Reply> open_clock(const local::OpenClock& request, DescriptorQueue& descriptors);
  Reply list_opens() const;
  Reply get_daemon() const;

  Registry& registry_;
  OpenTable& opens_;
  PlaybackClockOwner& clock_;
  CatalogRequests catalog_;
};

}  // namespace dssm::daemon
