// SPDX-License-Identifier: Apache-2.0
#include "daemon/serve/channel_server.hpp"

#include <sys/socket.h>

#include <cerrno>
#include <utility>

#include "core/wire/frame.hpp"
#include "core/wire/tcp.hpp"
#include "daemon/base/message_ids.hpp"

namespace dssm::daemon {
namespace {

// Accepted in a row before those who are connected get their turn.
constexpr int kPeersPerTurn = 16;

// How often heartbeats make us look at the streams whose doorbells did not ring: a writer may have
// been killed between writing and ringing.
constexpr Duration kLookPeriod = std::chrono::milliseconds(900);

}  // namespace

ChannelServer::ChannelServer(const Parts& parts, wire::Greeting self,
                             const PeerTable::Limits& limits)
    : parts_(parts),
      logger_(parts.logger),
      self_(std::move(self)),
      peers_(limits),
      streams_(parts.loop),
      sweep_(EventSource::timer(parts.loop, [this] { sweep(); })) {
  parts_.registry.add_observer(*this);
}

ChannelServer::~ChannelServer() {
  parts_.registry.remove_observer(*this);
  for (const auto& [key, communicator] : communicators_) {
    communicator->close_with(
        {Errc::unavailable, "dssmd of host '" + self_.host + "' is being stopped"});
  }
}

void ChannelServer::serve(const NetworkListener& listener) {
  for (const UniqueFd& socket : listener.sockets()) {
    const int fd = socket.get();
    incoming_.push_back(EventSource::readable(parts_.loop, fd, [this, fd] { on_connection(fd); }));
    incoming_.back().enable();
  }
}

void ChannelServer::on_connection(int listener) {
  for (int i = 0; i < kPeersPerTurn; ++i) {
    UniqueFd socket(::accept4(listener, nullptr, nullptr, SOCK_CLOEXEC | SOCK_NONBLOCK));
    if (socket) {
      accept(std::move(socket));
    } else if (errno == EMFILE || errno == ENFILE) {
      return spare_.accept_to_refuse(listener, [this](UniqueFd last) {
        turn_away(std::move(last), nullptr,
                  {Errc::limit_exceeded,
                   "dssmd of host '" + self_.host +
                       "' has no descriptors left (ulimit -n, LimitNOFILE=); raise that limit, or "
                       "lower max_clients, max_streams and max_connections"});
      });
    } else if (errno == EINTR || errno == ECONNABORTED) {
      continue;
    } else {
      if (errno != EAGAIN) logger_.warning(os_error("accept a connection, skipping").message);
      return;
    }
  }
}

void ChannelServer::accept(UniqueFd socket) {
  const Result<wire::SocketAddress> address = wire::peer_address(socket.get());
  if (!address) return;  // gone already
  Result<PeerPlace> place = peers_.admit(*address);
  if (!place) {
    return turn_away(std::move(socket), &*address,
                     std::move(place).error().context("dssmd of host '" + self_.host + "'"));
  }
  wire::set_channel_options(socket.get());
  keep(*std::move(place), wire::make_tcp_transport(std::move(socket)), *address);
}

Result<void> ChannelServer::adopt(std::unique_ptr<wire::Transport> transport,
                                  const wire::SocketAddress& address) {
  Result<PeerPlace> place = peers_.admit(address);
  if (!place) return std::move(place).error();
  keep(*std::move(place), std::move(transport), address);
  return {};
}

void ChannelServer::keep(PeerPlace place, std::unique_ptr<wire::Transport> transport,
                         const wire::SocketAddress& address) {
  auto communicator = std::make_unique<DataCommunicator>(
      DataCommunicator::Parts{parts_.loop, parts_.registry, parts_.opens, streams_, self_, logger_,
                              *this, parts_.clock},
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

void ChannelServer::turn_away(UniqueFd socket, const wire::SocketAddress* address,
                              const Error& error) {
  logger_.warning("refuse a connection" +
                      (address ? " from '" + address->str() + "'" : std::string()) + ": " +
                      error.message,
                  {.message_id = message_id::kPeerRefused});
  net::Frame final_failure;
  wire::to_message(error, *final_failure.mutable_failure());
  const std::string words = wire::encode_frame(final_failure);
  // As much as fits: the peer is gone from here in any case.
  static_cast<void>(::send(socket.get(), words.data(), words.size(), MSG_NOSIGNAL | MSG_DONTWAIT));
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
  if (now - looked_ < kLookPeriod) return;
  looked_ = now;
  streams_.look_at_all();
}

}  // namespace dssm::daemon
