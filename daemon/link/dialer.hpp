// SPDX-License-Identifier: Apache-2.0
//
// Keeps one outgoing connection up: looks the address up, connects, greets, and when the connection
// breaks does it all again, after a pause that grows from kFirstPause to kLongestPause and never
// gives up. Used by PeerConnection (control connections), mirrors and remote writers (channels).
//
// Of several addresses the first that connects is taken. When nobody greets there, or when
// restart() gave the connection up, the next round begins with the one behind it.
#pragma once

#include <memory>
#include <string>
#include <vector>

#include "core/wire/address.hpp"
#include "core/wire/network_protocol.hpp"
#include "daemon/base/event_loop.hpp"
#include "daemon/link/frame_connection.hpp"
#include "daemon/link/resolver.hpp"

namespace dssm::daemon {

class Dialer final : private FrameConnection::Observer {
 public:
  static constexpr Duration kFirstPause = std::chrono::milliseconds(50);
  static constexpr Duration kLongestPause = std::chrono::seconds(2);
  static constexpr Duration kConnectTimeout = std::chrono::seconds(2);  // of one address

  class Observer {
   public:
    // Both greetings are exchanged: ask away. `link` is the dialer's and good until on_down().
    virtual void on_up(FrameConnection& link, const wire::Greeting& them) = 0;
    virtual Result<void> on_frame(net::Frame& frame) = 0;
    virtual void on_output_empty() {}
    // The connection broke, or an attempt failed; the dialer goes on trying by itself. Called for
    // each failed round of attempts too. Whoever refused us did so in words, which are in `why`.
    virtual void on_down(const Error& why) = 0;

   protected:
    ~Observer() = default;
  };

  struct Options {
    // Best first, at least one: numbers, or one name, which is looked up anew for each round of
    // attempts.
    std::vector<wire::Address> addresses;
    wire::Greeting self;  // what to say
    std::size_t max_queued_bytes = 1U << 20;
    Duration longest_pause = kLongestPause;
    Duration round_time = Duration::max();  // all addresses share it, none gets > kConnectTimeout
  };

  // Starts at once. resolver, loop and observer outlive it. Destroying it, outside of its own
  // callbacks, closes the connection.
  Dialer(const EventLoop& loop, Resolver& resolver, Options options, Observer& observer);
  Dialer(const Dialer&) = delete;
  Dialer& operator=(const Dialer&) = delete;
  ~Dialer();

  // Tries at once instead of waiting for the pause to end (the other side just showed up).
  void retry_now();
  // Gives up the connection or the attempt that is under way: on_down() follows from the loop, then
  // the next attempt after the pause that is due. While it pauses anyway: nothing.
  void restart(const Error& why);
  // Where to go from the next round of attempts on. That begins at once when one is just waiting
  // for somebody to answer; what is up stays as it is.
  void set_addresses(std::vector<wire::Address> addresses);

  FrameConnection* link() noexcept;  // nullptr unless up
  // For on_down(): how far the attempt or connection had come that ended.
  enum class Phase : unsigned char { look_up, connect, greet, up };
  Phase reached() const noexcept;
  std::string address() const;            // connected to, else the first
  bool crosses_network() const noexcept;  // connected to another address than loopback

 private:
  struct State;
  std::unique_ptr<State> state_;
  Result<void> on_frame(net::Frame& frame) override;
  void on_output_empty() override;
  void on_closed(const Error& why) override;
};

}  // namespace dssm::daemon
