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

// How many handshakes continue in one turn of the loop: each time may take operations with private
// keys, 0.1 ms to some ms, and any number of handshakes may be due at once. The others continue in
// later turns, those first that were ready first. The connecting ends have a budget of their own,
// so that many who connect do not keep this host from connecting. loop outlives it.
class HandshakeBudget {
 public:
  static constexpr int kPerTurn = 4;

  explicit HandshakeBudget(const EventLoop& loop)
      : next_turn_(EventSource::timer(loop, [this] { left_ = kPerTurn; })) {}
  HandshakeBudget(const HandshakeBudget&) = delete;
  HandshakeBudget& operator=(const HandshakeBudget&) = delete;

  bool try_take() noexcept {
    if (left_ == 0) return false;
    if (left_-- == kPerTurn) next_turn_.enable_in(Duration::zero());
    return true;
  }

 private:
  int left_ = kPerTurn;
  EventSource next_turn_;
};

class Handshake {
 public:
  // Called once, from the loop, and when it throws bad_alloc once more, with no_memory; must not
  // destroy the handshake. Null: the other side closed an accepted connection before its first
  // byte.
  using Then = std::function<void(Result<std::unique_ptr<wire::Transport>>)>;

  // Both start at once; loop outlives them.
  //   budget  of all of them at this end; outlives the handshake
  // The connecting end.
  //   ticket  of the last connection there; outlives the handshake and the transport
  Handshake(const EventLoop& loop, std::shared_ptr<const wire::TlsCredentials> credentials,
            UniqueFd socket, wire::TlsTicket& ticket, HandshakeBudget& budget, Then then);
  // The accepting end.
  //   takes_plain  connections without TLS are passed on
  Handshake(const EventLoop& loop, std::shared_ptr<const wire::TlsCredentials> credentials,
            UniqueFd socket, HandshakeBudget& budget, bool takes_plain, Then then);
  Handshake(const Handshake&) = delete;
  Handshake& operator=(const Handshake&) = delete;

  // From now on nothing happens, and the connection is closed.
  void stop();

 private:
  Handshake(const EventLoop& loop, std::shared_ptr<const wire::TlsCredentials> credentials,
            UniqueFd socket, wire::TlsTicket* ticket, HandshakeBudget& budget, bool takes_plain,
            Then then);
  void on_ready();
  void recognize();
  void go_on();
  void finish(Result<std::unique_ptr<wire::Transport>> result);

  const std::shared_ptr<const wire::TlsCredentials> credentials_;
  wire::TlsTicket* const ticket_;  // of the connecting end
  HandshakeBudget& budget_;
  const bool accepts_;
  const bool takes_plain_;
  const Then then_;
  UniqueFd socket_;  // until the first byte came
  std::optional<wire::TlsHandshake> tls_;
  EventSource readable_, writable_, timer_;
};

}  // namespace dssm::daemon
