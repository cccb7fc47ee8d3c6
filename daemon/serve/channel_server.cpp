// SPDX-License-Identifier: Apache-2.0
#include "daemon/serve/channel_server.hpp"

#include <fmt/format.h>

#include <utility>

#include "core/base/try.hpp"
#include "core/wire/tcp.hpp"
#include "daemon/base/message_ids.hpp"

namespace dssm::daemon {
namespace {

// Heartbeats cause a check of all streams at most once in this period: a writer may have been
// killed after it wrote a sample and before it wrote to the doorbell.
constexpr Duration kCheckPeriod = std::chrono::milliseconds(900);

}  // namespace

ChannelServer::ChannelServer(const Parts& parts, wire::Greeting self,
                             const PeerTable::Limits& limits)
    : parts_(parts),
      logger_(parts.logger),
      self_(std::move(self)),
      peers_(limits),
      streams_(parts.loop),
      sweep_(EventSource::timer(parts.loop, [this] { sweep(); })),
      acceptor_(parts.loop, logger_, "a connection", self_.host, message_id::kPeerRefused,
                [this](UniqueFd& socket) { return accept(socket); }) {
  parts_.registry.add_observer(*this);
}

ChannelServer::~ChannelServer() {
  parts_.registry.remove_observer(*this);
  for (const auto& [key, communicator] : communicators_) {
    communicator->close_with({Errc::unavailable, "dssmd of host '" + self_.host + "' is stopping"});
  }
}

void ChannelServer::serve(const NetworkListener& listener) {
  for (const UniqueFd& socket : listener.sockets()) acceptor_.listen(socket.get());
}

Result<void> ChannelServer::accept(UniqueFd& socket) {
  const Result<wire::SocketAddress> address = wire::peer_address(socket.get());
  if (!address) return {};  // the peer has closed it already
  Result<PeerPlace> place = peers_.admit(*address);
  if (!place) {
    return std::move(place).error().context(
        fmt::format("dssmd of host '{}' refuses '{}'", self_.host, address->str()));
  }
  keep(*std::move(place), wire::make_transport(std::move(socket), wire::TransportEnd::accepted),
       *address);
  return {};
}

Result<void> ChannelServer::adopt(std::unique_ptr<wire::Transport> transport,
                                  const wire::SocketAddress& address) {
  PeerPlace place = DSSM_TRY(peers_.admit(address));
  keep(std::move(place), std::move(transport), address);
  return {};
}

void ChannelServer::keep(PeerPlace place, std::unique_ptr<wire::Transport> transport,
                         const wire::SocketAddress& address) {
  auto communicator = std::make_unique<DataCommunicator>(
      DataCommunicator::Parts{parts_.loop, parts_.registry, parts_.opens, streams_, self_, logger_,
                              *this, parts_.clock, parts_.authorizer, sending_},
      std::move(place), std::move(transport), address.str());
  DataCommunicator* key = communicator.get();
  communicators_.emplace(key, std::move(communicator));
}

void ChannelServer::send_clock() {
  for (const auto& [key, communicator] : communicators_) communicator->send_clock();
}

// Also streams that only the dssmd before this one had served.
void ChannelServer::on_clock() {
  if (!parts_.clock) return;
  for (const std::shared_ptr<Stream>& stream : parts_.registry.streams()) {
    if (!stream->mapping().header().clock.is_set()) continue;
    Result<void> assessed = streams_.get(stream)->assess(parts_.clock->assess_own(stream->id()));
    if (!assessed) logger_.warning("assess the times of a stream: " + assessed.error().message);
  }
}

void ChannelServer::on_ended(DataCommunicator& communicator) {
  ended_.push_back(&communicator);
  sweep_.enable_in(Duration::zero());
}

void ChannelServer::sweep() {
  for (DataCommunicator* communicator : std::exchange(ended_, {})) {
    communicators_.erase(communicator);
  }
}

void ChannelServer::on_stream_added(const Stream& stream) {
  for (const auto& [key, communicator] : communicators_) communicator->on_stream_added(stream);
}

void ChannelServer::on_stream_removed(const Stream& stream) {
  streams_.forget(stream);
  for (const auto& [key, communicator] : communicators_) communicator->on_stream_removed(stream);
}

void ChannelServer::on_heartbeat() {
  if (parts_.on_heartbeat) parts_.on_heartbeat();
  const MonoTime now = parts_.loop.now();
  if (now - checked_ < kCheckPeriod) return;
  checked_ = now;
  streams_.check_all();
}

}  // namespace dssm::daemon
