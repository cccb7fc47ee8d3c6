// SPDX-License-Identifier: Apache-2.0
//
// Asks chronyd for the state of the clock, once a period. Each question has a socket and a random
// number of its own, so an answer that is late or belongs to another question is not accepted. No
// state is kept from one question to the next, so a chronyd that starts, ends or hangs is not a
// special case. Never blocks, and does bounded work in each period whatever is sent to it.
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
    // An answer, to a question sent at `asked`. Its values are not checked.
    virtual void on_answer(const TrackingReply& reply, MonoTime asked,
                           const clock::Instant& answered) = 0;
    // Nothing listens there; called after each question.
    virtual void on_no_chronyd() = 0;
    // A period has passed without a valid answer.
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

  // The process is awake for another reason: asks now when a question is nearly due. When this is
  // called once a period, the timer does not wake the process.
  void poll_if_due();

  // Something has changed: asks now, unless it did within kMinPause.
  static constexpr Duration kMinPause = std::chrono::milliseconds(50);
  void poll_now();

 private:
  struct Question {
    std::uint32_t sequence = 0;
    MonoTime asked;
    int datagrams = 0;         // that its socket received
    std::optional<Error> why;  // why none of them is the answer
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
  MonoTime asked_{}, awake_{};        // the last question; the last poll_if_due()
  std::optional<Question> question_;  // until it is answered or refused
  UniqueFd socket_;
  EventSource readable_, timer_;
};

}  // namespace dssm::daemon
