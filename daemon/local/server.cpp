// SPDX-License-Identifier: Apache-2.0
#include "daemon/local/server.hpp"

#include <fmt/format.h>
#include <sys/socket.h>

#include <utility>

#include "daemon/base/message_ids.hpp"

namespace dssm::daemon {

Server::Server(const EventLoop& loop, const Listener& listener, const std::string& host,
               std::uint64_t max_clients, LocalService& service, Logger& logger)
    : loop_(loop),
      max_clients_(max_clients),
      service_(service),
      logger_(logger),
      sweep_(EventSource::timer(loop,
                                [this] {
                                  for (const std::uint64_t number : std::exchange(ended_, {})) {
                                    connections_.erase(number);
                                  }
                                })),
      acceptor_(loop, logger, "a program", host, message_id::kClientRefused,
                [this](UniqueFd& socket) { return accept(socket); }) {
  acceptor_.listen(listener.fd());
}

Result<void> Server::accept(UniqueFd& socket) {
  if (connections_.size() - ended_.size() >= max_clients_) {
    return Error{Errc::limit_exceeded,
                 fmt::format("max_clients = {} programs are connected already; end some or raise "
                             "the key max_clients",
                             max_clients_)};
  }
  ucred peer{};
  socklen_t length = sizeof peer;
  if (::getsockopt(socket.get(), SOL_SOCKET, SO_PEERCRED, &peer, &length)) {
    return os_error("get the credentials of a program");
  }
  Identity identity;
  identity.pid = peer.pid;
  identity.uid = peer.uid;
  identity.gid = peer.gid;
  const std::uint64_t number = next_++;
  connections_.emplace(number, std::make_unique<Connection>(loop_, std::move(socket), identity,
                                                            service_, logger_, [this, number] {
                                                              ended_.push_back(number);
                                                              sweep_.enable_in(Duration::zero());
                                                            }));
  return {};
}

}  // namespace dssm::daemon
