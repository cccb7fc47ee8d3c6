// SPDX-License-Identifier: Apache-2.0
//
// Where and when to connect, for both users of the network protocol's client end: dssmd (Dialer)
// and PConnector (NetworkConnection). It opens no socket and reads no clock: its user reports what
// happened and asks what is next.
//
//   round   tries all addresses, in turn, until one connects. When the other side did not greet, or
//           the connection was given up, the next round begins with the address after it
//   pause   between rounds, from kFirstPause on, doubled each time, up to kMaxPause. It starts
//           again with kFirstPause after a connection that was useful, and after on_no_answer()
//   recent  for kRecentTime after a useful connection on a fast network, attempts and pauses are
//           short, unless the other side accepts connections and ends them. What ended the useful
//           one, as a cut cable or a restart, is usually soon over, and the kernel repeats a first
//           packet that was lost only after 1 s. A dssmd sends others meanwhile (repeat_after())
#pragma once

#include <dssm/result.hpp>
#include <dssm/time.hpp>
#include <optional>
#include <string>
#include <vector>

#include "core/wire/address.hpp"

namespace dssm::channel {

// A value; one thread.
class ConnectPlan {
 public:
  static constexpr Duration kFirstPause = std::chrono::milliseconds(10);
  static constexpr Duration kMaxPause = std::chrono::seconds(1);
  // When the kernel repeats a lost first packet.
  static constexpr Duration kFirstRepeat = std::chrono::seconds(1);
  // For one address: longer than that.
  static constexpr Duration kConnectTimeout = std::chrono::seconds(2);
  static constexpr Duration kRecentTime = std::chrono::minutes(1);
  static constexpr Duration kRecentPause = std::chrono::milliseconds(100);    // at most
  static constexpr Duration kRecentTimeout = std::chrono::milliseconds(200);  // for one address
  static constexpr Duration kRepeat = std::chrono::milliseconds(20);          // of a first packet
  // On a fast network it takes at most so long to connect.
  static constexpr Duration kFastConnect = std::chrono::milliseconds(50);
  // Every so many rounds an attempt has kConnectTimeout: the network may have become slow.
  static constexpr int kLongRound = 32;
  // A connection that was up for so long was useful.
  static constexpr Duration kUsefulTime = std::chrono::seconds(2);

  // The addresses of a round share `round_time`; none gets more than kConnectTimeout.
  explicit ConnectPlan(Duration round_time = Duration::max()) noexcept : round_time_(round_time) {}

  // Begins a round with address(). `addresses`: best first, at least one.
  void begin_round(std::vector<wire::SocketAddress> addresses);
  // Those of this round, or of the last one; none before the first.
  const std::vector<wire::SocketAddress>& addresses() const noexcept { return addresses_; }
  // What is tried now, or connected to; only after begin_round().
  const wire::SocketAddress& address() const noexcept { return addresses_[current_]; }
  // How long it may take to connect to it.
  Duration connect_timeout() const noexcept;
  // After this time without an answer another first packet is sent, by an attempt beside those that
  // wait already; then again.
  std::optional<Duration> repeat_after() const noexcept {
    return is_recent_ ? std::optional(kRepeat) : std::nullopt;
  }
  // connect_timeout() is over.
  void on_no_answer() noexcept {
    if (is_recent_) reset_pause();
  }
  // Why it failed then.
  std::string no_answer_text() const;
  // Connecting to address() failed. Whether there is a next one, which is address() now.
  bool next_address() noexcept;

  // How long it took to connect to address(). Without this call no network counts as fast.
  void on_connected(Duration took) noexcept {
    if (took < kFirstRepeat) is_fast_ = took <= kFastConnect;
  }
  // The greeting is done.
  void on_up(MonoTime now) noexcept { up_since_ = now; }
  // The round failed, or the connection ended. avoid_address: address() is tried last in the next
  // round. Returns the pause until that one.
  Duration end_round(MonoTime now, bool avoid_address);
  // The next pause is kFirstPause: the other side did what it was connected for, or has just become
  // available.
  void reset_pause() noexcept { pause_ = kFirstPause; }

 private:
  Duration round_time_;
  std::vector<wire::SocketAddress> addresses_;
  std::size_t current_ = 0;
  std::string avoided_;  // the address to try last; empty: none
  std::optional<MonoTime> up_since_;
  bool is_fast_ = false;             // the network, when it was connected last
  std::optional<MonoTime> lost_at_;  // when the last useful connection ended, on a fast network
  bool is_recent_ = false;           // that was less than kRecentTime ago
  int round_ = 0;                    // since the last useful connection
  Duration pause_ = kFirstPause;     // the next one
};

}  // namespace dssm::channel
