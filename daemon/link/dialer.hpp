// SPDX-License-Identifier: Apache-2.0
//
// Keeps one outgoing connection up: looks the address up, connects, exchanges greetings. When the
// connection breaks it does all of that again, after a pause, until it is stopped. Which address is
// tried next, and how long the pauses are, is ConnectPlan's. Used by PeerConnection (control
// connections), mirrors and remote writers (channels).
//
//           found             connected            Hello
//   look_up ------> connect ------------> greet ----------> up
//     ^    address |  ^  | next address     (with credentials: secure, then greet)
//     |            |  +--+
//     | timer      v no address is left, no greeting, connection closed, restart()
//   pause <------------------------------------------------ every other state
#pragma once

#include <cstdint>
#include <list>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "core/channel/connect_plan.hpp"
#include "core/wire/address.hpp"
#include "core/wire/network_protocol.hpp"
#include "daemon/base/event_loop.hpp"
#include "daemon/link/frame_connection.hpp"
#include "daemon/link/handshake.hpp"
#include "daemon/link/resolver.hpp"

namespace dssm::daemon {

class Dialer final : private FrameConnection::Observer {
 public:
  class Observer {
   public:
    // Both greetings are exchanged: requests may be sent. `connection` is the dialer's and valid
    // until on_down().
    virtual void on_up(FrameConnection& connection, const wire::Greeting& them) = 0;
    virtual Result<void> on_frame(net::Frame& frame) = 0;
    virtual void on_output_empty() {}
    // The connection broke, or a round of attempts failed; the dialer continues by itself, unless
    // it was stopped. When the other side refused the connection, `why` holds its reason.
    virtual void on_down(const Error& why) = 0;

   protected:
    ~Observer() = default;
  };

  struct Options {
    // Best first, at least one: numbers, or one name, which is looked up again for each round of
    // attempts.
    std::vector<wire::Address> addresses;
    wire::Greeting self;  // to send; its credentials are used
    // Of all dialers; outlives them. nullptr: without credentials only.
    HandshakeBudget* handshakes = nullptr;
    std::size_t max_queued_bytes = 1U << 20;
    Duration round_time = Duration::max();  // as in ConnectPlan
    // After a useful connection, tries often for a while ("recent" in ConnectPlan). A channel need
    // not: the control connection finds out when the other side is back.
    bool retries_often = false;
  };

  // Starts at once. resolver, loop and observer outlive it. Destroying it, outside of its own
  // callbacks, closes the connection.
  Dialer(const EventLoop& loop, Resolver& resolver, Options options, Observer& observer);
  Dialer(const Dialer&) = delete;
  Dialer& operator=(const Dialer&) = delete;

  // Ends the pause, or what stop() began: the other side may just have become available. Also
  // ends a round of attempts that began `min_age` ago or earlier, and begins a new one: the
  // kernel repeats a lost first packet only after a second.
  void retry_now(Duration min_age = Duration::max());
  static constexpr Duration kMinRound = std::chrono::milliseconds(500);
  // Gives up the connection or the attempt that is under way: on_down() follows from the loop, then
  // the next attempt after the pause that is due. During a pause: nothing.
  void restart(const Error& why);
  // Like restart(), but no attempt follows before retry_now(), also during a pause.
  void stop(const Error& why);
  // The addresses from the next round of attempts on. That begins at once when an attempt waits for
  // an answer; a connection that is up stays as it is.
  void set_addresses(std::vector<wire::Address> addresses);
  // The own credentials were replaced: gives up a connection whose other side they do not accept.
  void on_new_credentials();

  FrameConnection* connection() noexcept;  // nullptr unless up
  // For on_down(): how far the attempt or connection had come that ended.
  enum class Phase : unsigned char { look_up, connect, greet, up };
  Phase reached() const noexcept { return reached_; }
  std::string address() const;  // connected to, else the first
  // What was found when they were looked up last; none yet: none.
  const std::vector<wire::SocketAddress>& found_addresses() const noexcept {
    return plan_.addresses();
  }
  // Connected to another PC (as far as the address says so), and not encrypted.
  bool is_insecure() const noexcept;

 private:
  enum class State : std::uint8_t {
    look_up,  // until the resolver answers
    connect,  // until a socket is connected, or the timer
    secure,   // until the TLS handshake ended
    greet,    // until their Hello came, or the timer
    up,       // until the connection closes
    give_up,  // restart() was called: until the timer, at once
    pause,    // until the timer; after stop() until retry_now()
  };

  // FrameConnection::Observer
  Result<void> on_frame(net::Frame& frame) override;
  void on_output_empty() override;
  void on_closed(const Error& why) override;

  // To connect to one address.
  struct Attempt {
    UniqueFd socket;
    MonoTime began;
    EventSource connected;
  };
  // Beside each other: all repeats within ConnectPlan::kRecentTimeout, and the first one, which the
  // kernel repeats when the network has become slow.
  static constexpr std::size_t kMaxAttempts =
      channel::ConnectPlan::kRecentTimeout / channel::ConnectPlan::kRepeat + 1;

  void begin_round();
  void begin_round_soon();
  void try_addresses(std::vector<wire::SocketAddress> found);
  void try_address();
  void try_next_address(const Error& why);
  Result<void> begin_attempt();
  void end_attempts();
  void await_answer();
  void on_connected(Attempt& attempt);
  void greet(std::unique_ptr<wire::Transport> transport);
  void on_timer();
  Result<void> greet_untrusted(const net::Frame& frame);
  void fail(const Error& why);
  std::string peer_name() const;

  const EventLoop& loop_;
  Resolver& resolver_;
  Options options_;
  Observer& observer_;

  State state_ = State::pause;
  Phase reached_ = Phase::look_up;  // in this round, or in the last one
  channel::ConnectPlan plan_;
  MonoTime round_began_{};
  Resolver::Ticket lookup_;
  std::list<Attempt> attempts_;  // oldest first; kept until others begin
  wire::TlsTicket ticket_;
  // Until the next round, as the connection below.
  std::unique_ptr<Handshake> handshake_;
  // Until the next round: a FrameConnection must not be destroyed in its own callbacks.
  std::unique_ptr<FrameConnection> connection_;
  std::optional<wire::Greeting> them_;
  std::optional<Error> reason_;  // why the connection is about to close, if known here
  bool given_up_ = false;        // by restart(), while it was up
  bool stopped_ = false;         // by stop()
  EventSource timer_;
};

}  // namespace dssm::daemon
