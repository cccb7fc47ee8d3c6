// SPDX-License-Identifier: Apache-2.0
//
// What clients may ask about streams, request by request: from the protocol's messages to Registry,
// OpenTable and PlaybackClockOwner, and back. No sockets and no events here; LocalService decides
// whose turn it is.
#pragma once

#include <deque>
#include <dssm/result.hpp>
#include <memory>
#include <vector>

#include "core/base/unique_fd.hpp"
#include "daemon/streams/open_table.hpp"
#include "daemon/streams/playback_clock_owner.hpp"
#include "daemon/streams/registry.hpp"
#include "local.pb.h"

namespace dssm::daemon {

// An answer and the descriptors that go with it, in the order that local.proto says.
struct Reply {
  local::Response response;
  std::vector<UniqueFd> descriptors;
};

// Descriptors that arrived, one element per message that brought some. A request that takes
// descriptors takes the oldest element.
using DescriptorQueue = std::deque<std::vector<UniqueFd>>;

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

  // What List and Info tell of a stream, without its users.
  void describe(const Stream& stream, proto::Stream& out) const;

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
  void note_open(const Client& client, const std::shared_ptr<Stream>& stream, Role role,
                 std::uint32_t tag, local::Opened& opened);

  Registry& registry_;
  OpenTable& opens_;
  PlaybackClockOwner& clock_;
};

}  // namespace dssm::daemon
