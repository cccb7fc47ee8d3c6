// SPDX-License-Identifier: Apache-2.0
//
// Asks chronyd again and again how the clock is. Each question goes out of a socket of its own,
// with a random number: an answer that comes late, or to somebody else, finds nobody; nothing is
// carried over from one question to the next, so a chronyd that comes, goes, or hangs needs no
// handling. Never blocks, and does bounded work in each period whatever is sent to it.
#pragma once

#include <cstddef>
#include <cstdint>
#include <functional>
#include <optional>
#include <span>

#include "core/base/unique_fd.hpp"
#include "core/wire/address.hpp"
#include "daemon/base/event_loop.hpp"
#include "daemon/clock/chrony_protocol.hpp"

namespace dssm::daemon {

class ChronydClient {
 public:
  static constexpr Duration kPeriod = std::chrono::seconds(1);
  // Datagrams that are read for one answer; then this question counts as unanswered.
  static constexpr int kMaxDatagrams = 16;

  using Now = std::function<clock::Instant()>;

  class Observer {
   public:
    // An answer, to a question sent at `asked`. What it says is not checked.
    virtual void on_answer(const TrackingReply& reply, MonoTime asked,
                           const clock::Instant& answered) = 0;
    // Nothing listens there; called after each question.
    virtual void on_no_chronyd() = 0;
    // A period has passed without an answer that can be read.
    virtual void on_no_answer(const Error& why) = 0;

   protected:
    ~Observer() = default;
  };

  // Asks at once when the loop runs, and then about once a period of the loop's time. What is given
  // by reference outlives it.
  //   now  stamps questions and answers
  ChronydClient(const EventLoop& loop, const wire::SocketAddress& chronyd, Observer& observer,
                Now now, Duration period = kPeriod);
  ChronydClient(const ChronydClient&) = delete;
  ChronydClient& operator=(const ChronydClient&) = delete;

  // The process is awake anyway: asks now when a question is about due. Where such occasions come
  // once a period, the timer does not wake it.
  void poll_if_due();

 private:
  struct Question {
    std::uint32_t sequence = 0;
    MonoTime asked;
    int datagrams = 0;         // that came to its socket
    std::optional<Error> why;  // none of them was an answer
  };

  void next_question();
  Result<void> ask();
  void on_readable();
  bool take_untrusted(std::span<const std::byte> datagram);
  void finish();

  const EventLoop& loop_;
  const wire::SocketAddress chronyd_;
  Observer& observer_;
  const Now now_;
  const Duration period_, slack_;
  MonoTime asked_{}, occasion_{};     // the last ones
  std::optional<Question> question_;  // until it is answered or refused
  UniqueFd socket_;
  EventSource readable_, timer_;
};

}  // namespace dssm::daemon
