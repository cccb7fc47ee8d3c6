// SPDX-License-Identifier: Apache-2.0
#include "daemon/local/server.hpp"

#include <sys/socket.h>

#include <cerrno>
#include <utility>

#include "core/wire/fd_socket.hpp"
#include "daemon/base/message_ids.hpp"

namespace dssm::daemon {
namespace {

// Accepted in a row before those who are connected get their turn.
constexpr int kClientsPerTurn = 16;

}  // namespace

Server::Server(const EventLoop& loop, const Listener& listener, std::uint64_t max_clients,
               LocalService& service, Logger& logger)
    : loop_(loop),
      listener_(listener),
      max_clients_(max_clients),
      service_(service),
      logger_(logger),
      incoming_(EventSource::readable(loop, listener.fd(), [this] { on_connection(); })),
      sweep_(EventSource::timer(loop, [this] {
        for (const std::uint64_t number : std::exchange(ended_, {})) connections_.erase(number);
      })) {
  incoming_.enable();
}

void Server::on_connection() {
  for (int i = 0; i < kClientsPerTurn; ++i) {
    UniqueFd socket(::accept4(listener_.fd(), nullptr, nullptr, SOCK_CLOEXEC | SOCK_NONBLOCK));
    if (socket) {
      accept(std::move(socket));
    } else if (errno == EMFILE || errno == ENFILE) {
      return spare_.accept_to_refuse(listener_.fd(), [this](UniqueFd last) {
        turn_away(std::move(last), {Errc::limit_exceeded,
                                    "dssmd has no descriptors left (ulimit -n, LimitNOFILE=); "
                                    "raise that limit, or lower max_clients and max_streams"});
      });
    } else if (errno == EINTR || errno == ECONNABORTED) {
      continue;
    } else {
      if (errno != EAGAIN) logger_.warning(os_error("accept a program, skipping").message);
      return;
    }
  }
}

void Server::accept(UniqueFd socket) {
  if (connections_.size() - ended_.size() >= max_clients_) {
    return turn_away(
        std::move(socket),
        {Errc::limit_exceeded, "max_clients = " + std::to_string(max_clients_) +
                                   " programs are connected already; end some or raise the key "
                                   "max_clients"});
  }
  ucred peer{};
  socklen_t length = sizeof peer;
  if (::getsockopt(socket.get(), SOL_SOCKET, SO_PEERCRED, &peer, &length)) {
    return turn_away(std::move(socket), os_error("ask who connected"));
  }
  const std::uint64_t number = next_++;
  connections_.emplace(
      number, std::make_unique<Connection>(loop_, std::move(socket), peer.pid, peer.uid, service_,
                                           logger_, [this, number] {
                                             ended_.push_back(number);
                                             sweep_.enable_in(Duration::zero());
                                           }));
}

void Server::turn_away(UniqueFd socket, const Error& error) {
  logger_.warning("refuse a program: " + error.message, {.message_id = message_id::kClientRefused});
  const std::string words = final_failure(error);
  // As much as fits: the program is gone from here in any case.
  static_cast<void>(wire::send_some(socket.get(), std::as_bytes(std::span(words)), {}));
}

}  // namespace dssm::daemon
