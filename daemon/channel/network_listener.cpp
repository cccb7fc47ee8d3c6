// SPDX-License-Identifier: Apache-2.0
#include "daemon/channel/network_listener.hpp"

#include <utility>

#include "core/wire/tcp.hpp"

namespace dssm::daemon {

Result<NetworkListener> NetworkListener::open(
    const std::optional<std::vector<wire::Address>>& configured, Logger& logger) {
  NetworkListener listener;
  const std::vector<wire::Address> defaults = {{"127.0.0.1", wire::kDefaultPort},
                                               {"::1", wire::kDefaultPort}};
  for (const wire::Address& address : configured.value_or(defaults)) {
    Result<void> added = listener.add(address);
    if (added) continue;
    if (configured) return std::move(added).error();
    logger.warning(added.error().message +
                   "; nobody asked for this address (key listen), going on without it");
  }
  return listener;
}

Result<void> NetworkListener::add(const wire::Address& address) {
  for (const wire::SocketAddress& number : wire::resolve_number(address)) {
    Result<UniqueFd> socket = wire::listen_tcp(number);
    if (!socket) return std::move(socket).error();
    const Result<wire::SocketAddress> bound = wire::local_address(socket->get());
    if (!bound) return bound.error();
    addresses_.push_back(bound->str());
    sockets_.push_back(*std::move(socket));
  }
  return {};
}

std::string NetworkListener::str() const {
  if (addresses_.empty()) return "no network";
  std::string text = "listening at ";
  for (const std::string& address : addresses_) {
    text.append(&address == &addresses_.front() ? "" : ", ").append(address);
  }
  return text;
}

}  // namespace dssm::daemon
