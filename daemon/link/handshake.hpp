// SPDX-License-Identifier: Apache-2.0
//
// A new connection of a dssmd with credentials, until it is known who is at the other end: TLS, by
// the time limit of the greeting. At the accepting end it also recognizes connections without TLS:
// those from this PC are passed on as they are, others are refused in plain text, so that their
// programs can say why.
#pragma once

#include <dssm/result.hpp>
#include <functional>
#include <memory>
#include <optional>

#include "core/base/unique_fd.hpp"
#include "core/wire/tls.hpp"
#include "daemon/base/event_loop.hpp"

namespace dssm::daemon {

class Handshake {
 public:
  // Called once, from the loop; must not destroy the handshake.
  using Then = std::function<void(Result<std::unique_ptr<wire::Transport>>)>;

  // Both start at once; loop outlives them.
  // The connecting end.
  //   ticket  of the last connection there; outlives the handshake and the transport
  Handshake(const EventLoop& loop, std::shared_ptr<const wire::TlsCredentials> credentials,
            UniqueFd socket, wire::TlsTicket& ticket, Then then);
  // The accepting end.
  //   takes_plain  connections without TLS are passed on
  Handshake(const EventLoop& loop, std::shared_ptr<const wire::TlsCredentials> credentials,
            UniqueFd socket, bool takes_plain, Then then);
  Handshake(const Handshake&) = delete;
  Handshake& operator=(const Handshake&) = delete;

  // From now on nothing happens, and the connection is closed.
  void stop();

 private:
  Handshake(const EventLoop& loop, std::shared_ptr<const wire::TlsCredentials> credentials,
            UniqueFd socket, wire::TlsTicket* ticket, bool takes_plain, Then then);
  void on_ready();
  void recognize();
  void go_on();
  void finish(Result<std::unique_ptr<wire::Transport>> result);

  const std::shared_ptr<const wire::TlsCredentials> credentials_;
  wire::TlsTicket* const ticket_;  // nullptr: of the accepting end
  const bool takes_plain_;
  const Then then_;
  UniqueFd socket_;  // until the first byte came
  std::optional<wire::TlsHandshake> tls_;
  EventSource readable_, writable_, timer_;
};

}  // namespace dssm::daemon
