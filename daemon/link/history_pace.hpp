// SPDX-License-Identifier: Apache-2.0
//
// How fast history is sent to one other host, over all connections to it: less than the network
// carries, so that no queue grows in it in which new samples of any stream would wait. The idea is
// LEDBAT's (RFC 6817), but the rate does not follow round trips, which vary between busy PCs by
// more than a queue adds. A new sample still waits behind the history sample that is begun on its
// own connection, and while the network is measured:
//
//   measuring  history is sent as fast as the connection takes it. Short windows until two in a
//              row carry no more than the one before: TCP is up to speed, and buffers that let
//              the first bytes pass faster are full. What is delivered in one more, kLastWindows
//              times as long, is what the network carries
//   paced      history gets kShare of that, without what live samples take of it, but at least
//              kLeastShare. Measured again after kMinValid to kMaxValid, and when a connection has
//              not taken what it was allowed to for kTooFull of kPeriod
//   unlimited  the network is fast, or one of the two PCs is what limits
//
// The host's connections share one, in the loop's thread.
#pragma once

#include <cstddef>
#include <cstdint>
#include <dssm/time.hpp>
#include <limits>

#include "core/wire/transport.hpp"

namespace dssm::daemon {

class HistoryPace {
 public:
  static constexpr double kShare = 0.85, kLeastShare = 0.05;
  // At least, and at least the round trip, and until so much is delivered: TCP repairs losses in
  // between. But when kMaxWindow is over, without so much.
  static constexpr Duration kWindow = std::chrono::milliseconds(5);
  static constexpr std::uint64_t kWindowBytes = 32U << 10;
  static constexpr Duration kMaxWindow = std::chrono::seconds(1);
  static constexpr double kGrows = 1.25;  // a window that carries so much more than the one before
  static constexpr int kMaxWindows = 100, kLastWindows = 3;
  // In which the connection was not full half of the time. Once full it counts so until there is
  // history again, but no longer than the kernel says that some had not arrived yet.
  static constexpr int kMaxVoidWindows = 20;
  static constexpr Duration kKernelTick = std::chrono::milliseconds(10);  // to which it says so
  // Packets that take so much longer than the quickest wait in a queue.
  static constexpr Duration kQueued = std::chrono::milliseconds(5);
  // So many times as long as it took to measure.
  static constexpr int kValidTimes = 200;
  static constexpr Duration kMinValid = std::chrono::seconds(10),
                            kMaxValid = std::chrono::minutes(1);
  static constexpr Duration kPeriod = std::chrono::seconds(1);
  static constexpr double kTooFull = 0.3;
  static constexpr double kFastBytesPerS = 200e6;  // from here on the network counts as fast
  // What is sent at once: what the network carries in that time.
  static constexpr Duration kPiece = std::chrono::milliseconds(1);
  static constexpr std::size_t kMinPieceBytes = 4U << 10;
  static constexpr std::size_t kUnlimited = std::numeric_limits<std::size_t>::max();

  // One of the connections, as it is now.
  struct Connection {
    const void* id;
    std::uint64_t sent_bytes;  // since it began
    const wire::Transport& transport;
  };

  // How many bytes of history may be sent over that connection now. 0: none before due().
  std::size_t allowance(MonoTime now, const Connection& connection);
  MonoTime due() const noexcept { return due_; }
  // What the network carries, when that is what limits and was measured lately; else 0.
  double carried_bytes_per_s(MonoTime now) const noexcept {
    return state_ == State::paced && now < valid_until_ ? bytes_per_s_ : 0;
  }

  // Of any kind, over any of the connections.
  void on_sent(std::size_t bytes) noexcept { sent_bytes_ += bytes; }
  // So much of what was sent, or will be because it is queued, is history.
  void on_history(std::size_t bytes) noexcept;
  // It was queued, and will not be sent.
  void on_history_dropped(std::size_t bytes) noexcept;
  // The connection with that id took less of the history than it was allowed to.
  void on_full(const void* connection) noexcept;
  // The connection with that id has ended.
  void forget(const void* connection) noexcept;

 private:
  enum class State : std::uint8_t { unknown, measuring, paced, unlimited };
  struct Window {
    const void* connection = nullptr;
    MonoTime begin{}, end{};
    MonoTime heard{};      // when that connection had history last
    Duration full_for{};   // so long it took no more
    bool is_full = false;  // since `heard`
    std::uint64_t sent_bytes = 0, sent_by_it_bytes = 0;
    wire::Progress progress;
  };

  void measure(MonoTime now, const Connection& connection);
  void go_on_measuring(MonoTime now, const Connection& connection);
  void begin_window(MonoTime now, const Connection& connection, const wire::Progress& progress);
  bool is_last_window() const noexcept { return flat_windows_ == 2 || windows_ == kMaxWindows; }
  void end_window(MonoTime now, const Connection& connection);
  void set_rate(MonoTime now, double bytes_per_s, std::uint64_t waiting_bytes) noexcept;
  void refill(MonoTime now) noexcept;
  bool is_valid(MonoTime now) noexcept;
  std::uint64_t live_bytes() const noexcept;
  double piece_bytes() const noexcept;

  State state_ = State::unknown;
  MonoTime begun_{};        // when measuring was
  MonoTime valid_until_{};  // what was found
  Window window_;
  int windows_ = 0, flat_windows_ = 0, void_windows_ = 0;
  double last_bytes_per_s_ = 0, bytes_per_s_ = 0;
  double tokens_ = 0;  // bytes of history that may be sent; < 0 after more
  MonoTime refilled_{}, due_{};
  std::uint64_t sent_bytes_ = 0, history_bytes_ = 0;  // since the beginning
  std::uint64_t live_bytes_ = 0;                      // at the last refill
  bool is_full_ = false;                              // since then
  MonoTime period_begin_{};
  Duration full_for_{};  // in this period
};

// At most so much of what the network carries is the history of one connection, when a pace is
// known.
class HistoryShare {
 public:
  // 0 < share <= 1
  void set(double share) noexcept { share_ = share; }

  // How many bytes of history may be sent now. 0: none before due().
  std::size_t allowance(MonoTime now, double carried_bytes_per_s) noexcept;
  MonoTime due() const noexcept { return due_; }

  void on_history(std::size_t bytes) noexcept { tokens_ -= static_cast<double>(bytes); }

 private:
  double share_ = 1;
  double tokens_ = 0;  // bytes that may be sent; < 0 after more
  MonoTime refilled_{}, due_{};
};

}  // namespace dssm::daemon
