// SPDX-License-Identifier: Apache-2.0
#include "daemon/serve/channel_server.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <optional>
#include <utility>

#include "core/base/text.hpp"
#include "core/base/try.hpp"
#include "core/wire/messages.hpp"
#include "core/wire/tcp.hpp"
#include "daemon/base/message_ids.hpp"

namespace dssm::daemon {
namespace {

// Heartbeats cause a check of all streams at most once in this period: a writer may have been
// killed after it wrote a sample and before it wrote to the doorbell.
constexpr Duration kCheckPeriod = std::chrono::milliseconds(900);

// Ports differ from connection to connection.
std::string without_port(const wire::SocketAddress& address) {
  const std::string text = address.str();
  return text.substr(0, text.rfind(':'));
}

std::string network_of(const wire::SocketAddress& address) {
  const std::optional<wire::IpAddress> ip = wire::IpAddress::of(address);
  return ip ? ip->network().str() : std::string();
}

}  // namespace

ChannelServer::ChannelServer(const Parts& parts, wire::Greeting self,
                             const PeerTable::Limits& limits)
    : parts_(parts),
      logger_(parts.logger),
      self_(std::move(self)),
      limits_(limits),
      peers_(limits),
      handshake_budget_(parts.loop),
      streams_(parts.loop),
      turns_(parts.loop),
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
  if (wire::credentials_of(self_)) {
    secure(std::move(socket), *address);
    return {};
  }
  auto transport = wire::make_transport(std::move(socket), wire::TransportEnd::accepted);
  Result<void> kept = keep(transport, *address);
  if (!kept) refuse(*transport, *address, kept.error());
  return {};
}

std::string ChannelServer::refuses(const wire::SocketAddress& address) const {
  return fmt::format("dssmd of host '{}' refuses '{}'", self_.host, address.str());
}

void ChannelServer::refuse(wire::Transport& transport, const wire::SocketAddress& address,
                           const Error& error) {
  logger_.warning(error.message, {.peer = address.str(), .message_id = message_id::kPeerRefused});
  const std::string frame = wire::final_failure(error);
  const iovec part{const_cast<char*>(frame.data()), frame.size()};
  static_cast<void>(transport.send({&part, 1}));  // as much as is taken at once
}

// Anybody can connect and say nothing. When there is no place for one more, one of those that have
// not greeted, and `may_go`, is given up: the oldest of the address with the most, in the network
// with the most: who has one IPv6 address has all of its /64. Who goes on greets within
// milliseconds. There is no limit per network, because all hosts of a vehicle may be in one.
void ChannelServer::give_up_one(const std::function<bool(const Arrival&)>& may_go) {
  std::map<std::string_view, std::uint64_t> of_address, of_network;
  for (const Arrival& one : arrivals_) {
    if (may_go(one)) ++of_address[one.address], ++of_network[one.network];
  }
  const auto crowd = [&](const Arrival& one) {
    return may_go(one) ? std::pair(of_network[one.network], of_address[one.address])
                       : std::pair(std::uint64_t{0}, std::uint64_t{0});
  };
  const auto given_up =
      std::max_element(arrivals_.begin(), arrivals_.end(),
                       [&](const Arrival& a, const Arrival& b) { return crowd(a) < crowd(b); });
  if (given_up == arrivals_.end() || !may_go(*given_up)) return;
  if (DataCommunicator* communicator = given_up->communicator) {
    const Error error{Errc::limit_exceeded,
                      fmt::format("give up a connection from {}: it has sent no Hello, and others "
                                  "need its place",
                                  given_up->peer)};
    logger_.warning(error.message, {.message_id = message_id::kPeerRefused});
    communicator->close_with(error);
    communicators_.erase(communicator);  // at once, for its place
  }
  arrivals_.erase(given_up);
}

// As many handshakes are under way as connections are allowed.
void ChannelServer::secure(UniqueFd socket, const wire::SocketAddress& address) {
  const std::string where = without_port(address);
  std::uint64_t from_there = 0, all = 0;
  for (const Arrival& one : arrivals_) {
    if (one.handshake) ++all, from_there += one.address == where;
  }
  const bool is_crowd = from_there >= limits_.max_connections_per_host;
  if (is_crowd || all >= limits_.max_connections) {
    give_up_one(
        [&](const Arrival& one) { return one.handshake && (!is_crowd || one.address == where); });
  }
  Arrival& arrival = arrivals_.emplace_back(Arrival{where, network_of(address)});
  const bool takes_plain = parts_.takes_plain || address.is_loopback();
  arrival.handshake = std::make_unique<Handshake>(
      parts_.loop, wire::credentials_of(self_), std::move(socket), handshake_budget_, takes_plain,
      [this, &arrival, address](Result<std::unique_ptr<wire::Transport>> transport) {
        on_secured(arrival, address, std::move(transport));
      });
}

void ChannelServer::on_secured(Arrival& arrival, const wire::SocketAddress& address,
                               Result<std::unique_ptr<wire::Transport>> transport) {
  arrival.ended = true;
  sweep_.enable_in(Duration::zero());
  // A host connects several times beside each other, and keeps one (ConnectPlan::repeat_after()).
  if (transport && !*transport) return;
  if (!transport) {
    return logger_.warning(fmt::format("{}: {}", refuses(address), transport.error().message),
                           {.peer = address.str(), .message_id = message_id::kPeerRefused});
  }
  if (Result<void> kept = keep(*transport, address); !kept) {
    refuse(**transport, address, kept.error());
  }
}

void ChannelServer::on_new_credentials() {
  const auto credentials = wire::credentials_of(self_);
  if (!credentials) return;
  // They would be accepted by the old ones; their hosts try again.
  std::erase_if(arrivals_, [](const Arrival& one) { return one.handshake != nullptr; });
  for (const auto& [key, communicator] : communicators_) {
    communicator->on_new_credentials(*credentials);
  }
}

Result<void> ChannelServer::adopt(std::unique_ptr<wire::Transport> transport,
                                  const wire::SocketAddress& address) {
  return keep(transport, address);
}

// Moves from `transport` only if there is a place.
Result<void> ChannelServer::keep(std::unique_ptr<wire::Transport>& transport,
                                 const wire::SocketAddress& address) {
  const std::string where = without_port(address);
  const wire::CertifiedPeer* certified = transport->peer();
  const std::string peer = account_of(address.str(), certified);
  const bool is_configured = parts_.is_configured && parts_.is_configured(address, certified);
  const bool is_crowd = peers_.is_full_for(peer, certified);
  if (is_crowd || (peers_.is_full(certified) && !is_configured)) {
    give_up_one([&](const Arrival& one) {
      return one.communicator && (is_crowd ? one.peer == peer : !one.is_configured);
    });
  }
  PeerPlace place = DSSM_TRY(peers_.admit(peer, certified, is_configured), refuses(address));
  auto communicator = std::make_unique<DataCommunicator>(
      DataCommunicator::Parts{parts_.loop, parts_.registry, parts_.opens, streams_, turns_, self_,
                              logger_, *this, parts_.clock, parts_.rights, sending_,
                              parts_.playback},
      std::move(place), std::move(transport), address.str());
  DataCommunicator* key = communicator.get();
  communicators_.emplace(key, std::move(communicator));
  arrivals_.push_back({where, network_of(address), nullptr, key, peer, is_configured});
  return {};
}

void ChannelServer::forget_arrival(const DataCommunicator& communicator) {
  std::erase_if(arrivals_, [&](const Arrival& one) { return one.communicator == &communicator; });
}

void ChannelServer::on_new_rights(const Rights& before) {
  for (const auto& [key, communicator] : communicators_) communicator->on_new_rights(before);
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

void ChannelServer::on_recovered() {
  for (const auto& [key, communicator] : communicators_) communicator->on_recovered();
}

void ChannelServer::on_ended(DataCommunicator& communicator) {
  forget_arrival(communicator);
  ended_.push_back(&communicator);
  sweep_.enable_in(Duration::zero());
}

void ChannelServer::sweep() {
  for (DataCommunicator* communicator : std::exchange(ended_, {})) {
    communicators_.erase(communicator);
  }
  std::erase_if(arrivals_, [](const Arrival& one) { return one.ended; });
}

void ChannelServer::on_stream_added(const Stream& stream) {
  for (const auto& [key, communicator] : communicators_) communicator->on_stream_added(stream);
}

void ChannelServer::on_property_set(const Stream& stream) {
  for (const auto& [key, communicator] : communicators_) communicator->on_property_set(stream);
}

void ChannelServer::on_stream_removed(const Stream& stream) {
  streams_.forget(stream);
  for (const auto& [key, communicator] : communicators_) communicator->on_stream_removed(stream);
}

void ChannelServer::on_heartbeat(const wire::Greeting* host,
                                 const std::optional<clock::HeartbeatTimes>& returned) {
  if (host && parts_.on_heartbeat) parts_.on_heartbeat(*host, returned);
  const MonoTime now = parts_.loop.now();
  if (now - checked_ < kCheckPeriod) return;
  checked_ = now;
  streams_.check_all();
}

}  // namespace dssm::daemon
