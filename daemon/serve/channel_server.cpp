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
  Result<PeerPlace> place = peers_.admit(in_quotes(without_port(*address)));
  if (!place) return std::move(place).error().context(refuses(*address));
  keep(*std::move(place), wire::make_transport(std::move(socket), wire::TransportEnd::accepted),
       *address);
  return {};
}

std::string ChannelServer::refuses(const wire::SocketAddress& address) const {
  return fmt::format("dssmd of host '{}' refuses '{}'", self_.host, address.str());
}

// Anybody can begin handshakes. As many are under way as connections are allowed; for one more, the
// oldest one is given up of the address with the most, in the network with the most: who has one
// IPv6 address has all of its /64. A handshake that goes on takes milliseconds. There is no limit
// per network, because all hosts of a vehicle may be in one.
void ChannelServer::secure(UniqueFd socket, const wire::SocketAddress& address) {
  const std::string where = without_port(address), network = network_of(address);
  std::map<std::string_view, std::uint64_t> of_address, of_network;
  for (const Arrival& one : arrivals_) ++of_address[one.address], ++of_network[one.network];
  const auto crowd = [&](const Arrival& one) {
    return std::pair(of_network[one.network], of_address[one.address]);
  };
  if (of_address[where] >= limits_.max_connections_per_host) {
    arrivals_.erase(std::find_if(arrivals_.begin(), arrivals_.end(),
                                 [&](const Arrival& one) { return one.address == where; }));
  } else if (arrivals_.size() >= limits_.max_connections) {
    arrivals_.erase(
        std::max_element(arrivals_.begin(), arrivals_.end(),
                         [&](const Arrival& a, const Arrival& b) { return crowd(a) < crowd(b); }));
  }
  Arrival& arrival = arrivals_.emplace_back(Arrival{where, network, nullptr, false});
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
  if (!transport) {
    return logger_.warning(fmt::format("{}: {}", refuses(address), transport.error().message),
                           {.peer = address.str(), .message_id = message_id::kPeerRefused});
  }
  const wire::CertifiedPeer* peer = (*transport)->peer();
  Result<PeerPlace> place =
      peers_.admit(peer ? peer->str() : in_quotes(arrival.address), peer != nullptr);
  if (!place) {
    const Error error = std::move(place).error().context(refuses(address));
    logger_.warning(error.message, {.peer = address.str(), .message_id = message_id::kPeerRefused});
    const std::string frame = wire::final_failure(error);
    const iovec part{const_cast<char*>(frame.data()), frame.size()};
    static_cast<void>((*transport)->send({&part, 1}));  // as much as is taken at once
    return;
  }
  keep(*std::move(place), *std::move(transport), address);
}

void ChannelServer::on_new_credentials() {
  const auto credentials = wire::credentials_of(self_);
  if (!credentials) return;
  arrivals_.clear();  // they would be accepted by the old ones; their hosts try again
  for (const auto& [key, communicator] : communicators_) {
    communicator->on_new_credentials(*credentials);
  }
}

Result<void> ChannelServer::adopt(std::unique_ptr<wire::Transport> transport,
                                  const wire::SocketAddress& address) {
  PeerPlace place = DSSM_TRY(peers_.admit(in_quotes(without_port(address))));
  keep(std::move(place), std::move(transport), address);
  return {};
}

void ChannelServer::keep(PeerPlace place, std::unique_ptr<wire::Transport> transport,
                         const wire::SocketAddress& address) {
  auto communicator = std::make_unique<DataCommunicator>(
      DataCommunicator::Parts{parts_.loop, parts_.registry, parts_.opens, streams_, self_, logger_,
                              *this, parts_.clock, parts_.rights, sending_},
      std::move(place), std::move(transport), address.str());
  DataCommunicator* key = communicator.get();
  communicators_.emplace(key, std::move(communicator));
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
