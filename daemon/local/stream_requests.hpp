// SPDX-License-Identifier: Apache-2.0
//
// What clients may ask about this host's streams, request by request: from the protocol's messages
// to Registry, OpenTable and PlaybackClockOwner, and back. No sockets and no events here;
// LocalService decides whose turn it is.
#pragma once

#include <dssm/result.hpp>
#include <memory>

#include "daemon/local/reply.hpp"
#include "daemon/streams/open_table.hpp"
#include "daemon/streams/playback_clock_owner.hpp"
#include "daemon/streams/registry.hpp"
#include "local.pb.h"

namespace dssm::daemon {

class StreamRequests {
 public:
  StreamRequests(Registry& registry, OpenTable& opens, PlaybackClockOwner& clock)
      : registry_(registry), opens_(opens), clock_(clock) {}

  using Client = std::shared_ptr<const ClientIdentity>;

  // Does what `request` asks for. Fails with what the client is told.
  Result<Reply> handle_untrusted(const Client& client, const local::Request& request,
                                 DescriptorQueue& descriptors);

  // The stream that `request` is about; nullptr for requests about none.
  static const proto::StreamId* subject(const local::Request& request) noexcept;

 private:
  Result<Reply> create(const Client& client, const local::Create& request);
  Result<Reply> open(const Client& client, const local::Open& request);
  Result<Reply> offer(const Client& client, const local::Offer& request,
                      DescriptorQueue& descriptors);
  Result<Reply> close(const Client& client, const local::Close& request);
  Result<Reply> remove(const local::Remove& request);
  Result<Reply> list();
  Result<Reply> info(const local::Info& request);
  Result<Reply> set_property(const local::SetProperty& request);
  Result<Reply> get_property(const local::GetProperty& request);
  Result<Reply> open_clock(const local::OpenClock& request, DescriptorQueue& descriptors);
  Result<Reply> list_opens();
  Result<Reply> get_daemon();

  Result<std::shared_ptr<Stream>> find_untrusted(const proto::StreamId& id) const;

  Registry& registry_;
  OpenTable& opens_;
  PlaybackClockOwner& clock_;
};

}  // namespace dssm::daemon
