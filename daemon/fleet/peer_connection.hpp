// SPDX-License-Identifier: Apache-2.0
//
// The control connection to one configured peer, or to one host that was found: keeps it up,
// carries requests and their answers, receives changes of the peer's streams, and decides by
// heartbeats whether the peer is alive. What a peer means for the catalog is decided by Peers.
#pragma once

#include <dssm/host_state.hpp>
#include <functional>
#include <map>
#include <optional>
#include <string>
#include <vector>

#include "core/base/time.hpp"
#include "core/wire/address.hpp"
#include "core/wire/network_protocol.hpp"
#include "daemon/base/event_loop.hpp"
#include "daemon/link/dialer.hpp"

namespace dssm::daemon {

class PeerConnection final : private Dialer::Observer {
 public:
  // Requests of one peer that wait for their answers, and their bytes: not of its heartbeats, which
  // programs cannot keep out.
  static constexpr std::size_t kMaxWaiting = 4096;
  static constexpr std::size_t kMaxWaitingBytes = 3U << 20;  // two properties of the largest size

  // Between two heartbeats that are repeated.
  static constexpr Duration kRepeat = wire::kHeartbeat * 3 / 2;
  // After a heartbeat that followed one of the peer: until then the next one of the peer comes.
  static constexpr Duration kFollow = wire::kHeartbeat * 9 / 8;

  // A found host that answers again is back within kFoundRoundTime + ConnectPlan::kMaxPause,
  // whichever of its addresses are dead; the design allows 3 s.
  static constexpr Duration kFoundRoundTime = std::chrono::milliseconds(1500);

  // Called from the loop; must not destroy the connection.
  class Observer {
   public:
    virtual void on_peer_up(PeerConnection& connection) = 0;
    // It was up, or, `attempt`: it could not be brought up.
    virtual void on_peer_down(PeerConnection& connection, const Error& error, bool attempt) = 0;
    // After watch(): a change of the peer's streams. Fails when it is not valid.
    virtual Result<void> on_stream_event_untrusted(PeerConnection& connection,
                                                   const proto::StreamEvent& event) = 0;
    // All streams that it had are reported.
    virtual void on_watched(PeerConnection& connection) = 0;
    // them() has the peer's newest clock.
    virtual void on_heartbeat(PeerConnection& connection) = 0;

   protected:
    ~Observer() = default;
  };

  // Starts at once; what is given outlives it. To a configured peer, whichever host that is:
  //   handshakes  as in Dialer::Options
  PeerConnection(const EventLoop& loop, Resolver& resolver, const wire::Address& peer,
                 const wire::Greeting& self, HandshakeBudget* handshakes, Observer& observer);
  // To the host `id`, which is announced at one of `addresses` (numbers, best first, at least
  // one); any other that answers there is refused.
  PeerConnection(const EventLoop& loop, Resolver& resolver, const wire::HostId& id,
                 const std::vector<wire::Address>& addresses, const wire::Greeting& self,
                 HandshakeBudget* handshakes, Observer& observer);
  PeerConnection(const PeerConnection&) = delete;
  PeerConnection& operator=(const PeerConnection&) = delete;

  // --- to be called while it is up

  // Sends a request (its serial is set here). `then` gets the answer or an error: the
  // peer's own, limit_exceeded (too much is waiting), unavailable (not up, or the connection
  // broke). Called once, from the loop, or at once when nothing was sent. When it throws bad_alloc
  // at the end of the connection, it is called once more, with no_memory.
  using Then = std::function<void(Result<net::Frame>)>;
  void ask(net::Frame request, Then then);

  // From now on on_stream_event_untrusted().
  void watch();

  // Sends a heartbeat each second, and closes the connection when the peer is dead: see beat().
  void start_heartbeat();
  // A heartbeat of the peer came. Both PCs are awake now, so this host sends its own at once, if
  // its last one was at least half a second ago: it is answered sooner than at other times, and
  // this host need not wake up for it. So one of the two hosts begins, always the same one. If its
  // heartbeat is answered late, it is repeated once, while both are awake; this is done for one of
  // two at most, so that both PCs do not wake up much more often.
  void on_their_heartbeat();

  // Closes the connection and dials again later.
  void drop(const Error& error) { dialer_.restart(error); }

  // Where to go from the next attempt on, which comes at once unless it is up.
  void set_addresses(const std::vector<wire::Address>& addresses);
  // Tries now, unless it is up: it may have become available.
  void on_network_changed();
  void on_new_credentials() { dialer_.on_new_credentials(); }

  // --- about the peer

  HostState state() const noexcept { return status_.state; }  // connecting, up, down or refused
  HostReason reason() const noexcept {
    return status_.reason;
  }  // none while it is up or connecting
  Duration in_this_state_for() const noexcept { return loop_.now() - status_.since; }
  const std::optional<Error>& last_error() const noexcept { return status_.error; }  // while not up
  // The greeting of the host that answers there; while it is not up, of the last one.
  const std::optional<wire::Greeting>& them() const noexcept { return them_; }
  // As configured; of a found host: its first address.
  const wire::Address& configured() const noexcept { return configured_; }
  std::string address() const { return dialer_.address(); }  // connected to, else configured()
  // Whether the name or number leads to that address, of any port.
  bool is_at(const wire::IpAddress& address) const;
  bool is_insecure() const noexcept { return dialer_.is_insecure(); }

  // Of the heartbeats of this connection; zero: not known.
  Duration last_round_trip() const noexcept { return round_trips_.last; }
  Duration min_round_trip() const noexcept { return round_trips_.min; }
  // From there to here, as that host measured lately; 0: not known, or the network is fast.
  std::uint64_t carried_bytes_per_s() const noexcept { return carried_bytes_per_s_; }

 private:
  // What state() and the like report.
  struct Status {
    HostState state = HostState::connecting;
    HostReason reason = HostReason::none;
    MonoTime since{};
    std::optional<Error> error = {};
  };
  struct RoundTrips {
    Duration last{}, min{};
  };
  struct Waiting {
    Then then;
    std::size_t bytes = 0;
  };
  // Requests that wait for their answers, by serial.
  struct Requests {
    std::uint64_t next_serial = 1;
    std::map<std::uint64_t, Waiting> waiting;
    std::size_t bytes = 0;
  };

  void on_up(FrameConnection& link, const wire::Greeting& them) override;
  Result<void> on_frame(net::Frame& frame) override;
  void on_down(const Error& error) override;
  void send(net::Frame request, Then then);
  void beat();
  void ping();
  void take_clock(std::shared_ptr<const wire::ClockReport> clock);
  void on_pong(MonoTime asked, RawTime asked_raw, const Result<net::Frame>& answer);
  RawTime arrival(RawTime read);
  void enter(HostState state, HostReason reason, std::optional<Error> error);

  PeerConnection(const EventLoop& loop, Resolver& resolver, std::optional<wire::HostId> expected,
                 Dialer::Options options, Observer& observer);

  const EventLoop& loop_;
  wire::Address configured_;
  const std::optional<wire::HostId> expected_;
  const wire::Greeting self_;
  Observer& observer_;
  Status status_;
  std::optional<wire::Greeting> them_;
  RoundTrips round_trips_;
  MonoTime beat_at_{}, their_beat_at_{}, repeated_at_{};
  bool follows_theirs_ = false;   // the next heartbeat
  bool is_repeatable_ = false;    // the last heartbeat
  RawTime asked_{}, answered_{};  // the last heartbeat; answered_ 0: not yet
  std::uint64_t carried_bytes_per_s_ = 0;
  bool watching_ = false;
  Requests requests_;
  EventSource heartbeat_;
  Dialer dialer_;  // last: it calls the others
};

}  // namespace dssm::daemon
