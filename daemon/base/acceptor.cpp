// SPDX-License-Identifier: Apache-2.0
#include "daemon/base/acceptor.hpp"

#include <fcntl.h>
#include <fmt/format.h>
#include <sys/socket.h>

#include <cerrno>
#include <utility>

#include "core/wire/messages.hpp"

namespace dssm::daemon {
namespace {

UniqueFd accept_at(int listener) {
  return UniqueFd(::accept4(listener, nullptr, nullptr, SOCK_CLOEXEC | SOCK_NONBLOCK));
}

UniqueFd make_spare() { return UniqueFd(::open("/dev/null", O_RDONLY | O_CLOEXEC)); }

}  // namespace

Acceptor::Acceptor(const EventLoop& loop, Logger& logger, std::string peer, std::string host,
                   std::string_view message_id, Accept accept)
    : loop_(loop),
      logger_(logger),
      peer_(std::move(peer)),
      host_(std::move(host)),
      message_id_(message_id),
      accept_(std::move(accept)),
      spare_(make_spare()),
      pause_(EventSource::timer(loop, [this] {
        if (!spare_) spare_ = make_spare();
        for (EventSource& listener : listeners_) listener.enable();
      })) {}

void Acceptor::listen(int listener) {
  listeners_.push_back(
      EventSource::readable(loop_, listener, [this, listener] { on_connection(listener); }));
  listeners_.back().enable();
}

void Acceptor::on_connection(int listener) {
  for (int i = 0; i < kConnectionsPerTurn; ++i) {
    if (closer_.is_full && closer_.is_full()) return pause();
    UniqueFd socket = accept_at(listener);
    if (socket) {
      if (Result<void> accepted = accept_(socket); !accepted) {
        refuse(std::move(socket), accepted.error());
      }
    } else if (errno == EMFILE || errno == ENFILE) {
      return accept_to_refuse(listener);
    } else if (errno == EINTR || errno == ECONNABORTED) {
      continue;
    } else {
      if (errno != EAGAIN) {
        logger_.warning(os_error(fmt::format("accept {}, skipping", peer_)).message);
      }
      return;
    }
  }
}

void Acceptor::accept_to_refuse(int listener) {
  spare_.reset();
  if (UniqueFd socket = accept_at(listener); socket) {
    refuse(std::move(socket),
           {Errc::limit_exceeded,
            fmt::format("dssmd of host '{}' has no descriptors left (ulimit -n, LimitNOFILE=); "
                        "raise that limit, or lower max_clients, max_streams and max_connections",
                        host_)});
  }
  spare_ = make_spare();
  if (!spare_) pause();  // the closer has that socket still
}

void Acceptor::pause() {
  for (EventSource& listener : listeners_) listener.disable();
  pause_.enable_in(kPause);
}

void Acceptor::refuse(UniqueFd socket, const Error& error) {
  logger_.warning(fmt::format("refuse {}: {}", peer_, error.message), {.message_id = message_id_});
  const std::string frame = wire::final_failure(error);
  // As much as the socket takes at once.
  static_cast<void>(::send(socket.get(), frame.data(), frame.size(), MSG_NOSIGNAL | MSG_DONTWAIT));
  if (closer_.close) closer_.close(std::move(socket));
}

}  // namespace dssm::daemon
