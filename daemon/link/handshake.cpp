// SPDX-License-Identifier: Apache-2.0
#include "daemon/link/handshake.hpp"

#include <poll.h>
#include <sys/socket.h>

#include <algorithm>
#include <cerrno>
#include <new>
#include <utility>

#include "core/wire/frame.hpp"
#include "core/wire/messages.hpp"
#include "core/wire/network_protocol.hpp"
#include "core/wire/tcp.hpp"
#include "daemon/base/memory_budget.hpp"

namespace dssm::daemon {

Handshake::Handshake(const EventLoop& loop, std::shared_ptr<const wire::TlsCredentials> credentials,
                     UniqueFd socket, wire::TlsTicket& ticket, HandshakeBudget& budget, Then then)
    : Handshake(loop, std::move(credentials), std::move(socket), &ticket, budget, false,
                std::move(then)) {
  writable_.enable();  // the connecting end begins
}

Handshake::Handshake(const EventLoop& loop, std::shared_ptr<const wire::TlsCredentials> credentials,
                     UniqueFd socket, HandshakeBudget& budget, bool takes_plain, Then then)
    : Handshake(loop, std::move(credentials), std::move(socket), nullptr, budget, takes_plain,
                std::move(then)) {}

Handshake::Handshake(const EventLoop& loop, std::shared_ptr<const wire::TlsCredentials> credentials,
                     UniqueFd socket, wire::TlsTicket* ticket, HandshakeBudget& budget,
                     bool takes_plain, Then then)
    : credentials_(std::move(credentials)),
      ticket_(ticket),
      budget_(budget),
      accepts_(!ticket),
      takes_plain_(takes_plain),
      then_(std::move(then)),
      socket_(std::move(socket)),
      readable_(EventSource::readable(loop, socket_.get(), [this] { on_ready(); })),
      writable_(EventSource::writable(loop, socket_.get(), [this] { on_ready(); })),
      timer_(EventSource::timer(loop, [this] {
        finish(Error{Errc::unavailable, "no TLS handshake within 3 s; is it a dssmd?"});
      })) {
  timer_.enable_in(wire::kHelloTimeout);
  readable_.enable();
}

void Handshake::on_ready() {
  try {
    if (!tls_ && accepts_) return recognize();
    go_on();
  } catch (const std::bad_alloc&) {
    finish(no_memory_left());
  }
}

void Handshake::recognize() {
  unsigned char first[2] = {};
  const ssize_t count = ::recv(socket_.get(), first, sizeof first, MSG_PEEK | MSG_DONTWAIT);
  if (count < 0 && (errno == EAGAIN || errno == EINTR)) return;
  if (count <= 0) return finish(std::unique_ptr<wire::Transport>());
  if (std::equal(first, first + count, wire::kTlsFirstBytes)) return go_on();
  if (takes_plain_) {
    return finish(wire::make_transport(std::move(socket_), wire::TransportEnd::accepted));
  }
  const Error why{Errc::no_permission,
                  "dssmd of host '" + credentials_->own().name +
                      "' takes encrypted connections only; give this side credentials of the same "
                      "authority (docs/security.md)"};
  const std::string frame = wire::final_failure(why);
  // As much as the socket takes at once.
  static_cast<void>(::send(socket_.get(), frame.data(), frame.size(), MSG_NOSIGNAL | MSG_DONTWAIT));
  finish(Error{Errc::no_permission, "the other side does not speak TLS"});
}

void Handshake::go_on() {
  if (!budget_.try_take()) return;  // the socket stays ready
  if (!tls_) {
    const auto end = accepts_ ? wire::TransportEnd::accepted : wire::TransportEnd::connected;
    tls_.emplace(credentials_, wire::make_transport(std::move(socket_), end), end, ticket_);
  }
  const Result<bool> done = tls_->go_on();
  if (!done) return finish(done.error());
  if (*done) return finish(tls_->take_transport());
  if (tls_->events() & POLLOUT) {
    writable_.enable();
  } else {
    writable_.disable();
  }
}

void Handshake::stop() {
  readable_.disable();
  writable_.disable();
  timer_.disable();
  tls_.reset();
  socket_.reset();
}

void Handshake::finish(Result<std::unique_ptr<wire::Transport>> result) {
  stop();
  then_(std::move(result));
}

}  // namespace dssm::daemon
