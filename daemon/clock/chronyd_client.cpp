// SPDX-License-Identifier: Apache-2.0
#include "daemon/clock/chronyd_client.hpp"

#include <sys/socket.h>

#include <array>
#include <cerrno>
#include <string>
#include <utility>

#include "core/wire/network_protocol.hpp"

namespace dssm::daemon {

ChronydClient::ChronydClient(const EventLoop& loop, const wire::SocketAddress& chronyd,
                             Observer& observer, Now now, Duration period)
    : loop_(loop),
      chronyd_(chronyd),
      observer_(observer),
      now_(std::move(now)),
      period_(period),
      slack_(period / 4),
      timer_(EventSource::timer(loop, [this] { next_question(); })) {
  timer_.enable_in(Duration::zero());
}

void ChronydClient::poll_if_due() {
  awake_ = loop_.now();
  if (awake_ - asked_ >= period_ - slack_) next_question();
}

void ChronydClient::poll_now() {
  // From the timer, because this may be called from the callback of the last answer's socket.
  if (!question_ && loop_.now() - asked_ >= kMinPause) timer_.enable_in(Duration::zero());
}

void ChronydClient::next_question() {
  asked_ = loop_.now();
  // Where poll_if_due() is called regularly, the timer expires only after its next call. A call
  // that is too early for a question is later within the period each time, until it is in time.
  const bool is_polled = asked_ - awake_ < period_ + slack_;
  timer_.enable_in(is_polled ? period_ + slack_ : period_);
  if (question_) {
    const Question unanswered = *std::exchange(question_, {});
    observer_.on_no_answer(unanswered.why.value_or(
        Error{Errc::unavailable, "it does not answer; does `chronyc tracking` work?"}));
  }
  if (Result<void> asked = ask(); !asked) observer_.on_no_answer(asked.error());
}

Result<void> ChronydClient::ask() {
  const std::string what = "ask chronyd at '" + chronyd_.str() + "'";
  readable_ = {};  // before its descriptor is closed
  socket_.reset(::socket(chronyd_.storage.ss_family, SOCK_DGRAM | SOCK_NONBLOCK | SOCK_CLOEXEC, 0));
  if (!socket_ || ::connect(socket_.get(), chronyd_.get(), chronyd_.length)) return os_error(what);
  Question question;
  question.sequence = static_cast<std::uint32_t>(wire::random_number());
  const auto request = tracking_request(question.sequence);
  question.asked = now_().mono;
  if (::send(socket_.get(), request.data(), request.size(), MSG_NOSIGNAL) < 0) {
    return os_error(what);
  }
  question_ = std::move(question);
  readable_ = EventSource::readable(loop_, socket_.get(), [this] { on_readable(); });
  readable_.enable();
  on_readable();  // ECONNREFUSED is there at once
  return {};
}

// The question needs its socket no more.
void ChronydClient::finish() {
  readable_.disable();
  socket_.reset();
}

void ChronydClient::on_readable() {
  while (socket_) {
    std::array<std::byte, 2 * kTrackingBytes> buffer;  // a longer one is not an answer
    const ssize_t size = ::recv(socket_.get(), buffer.data(), buffer.size(), 0);
    if (size < 0) {
      if (errno == EAGAIN) return;
      if (errno == EINTR) continue;
      const int errno_value = errno;
      finish();
      if (errno_value == ECONNREFUSED) {
        question_.reset();
        return observer_.on_no_chronyd();
      }
      question_->why = os_error("receive from '" + chronyd_.str() + "'", errno_value);
      return;
    }
    if (take_untrusted({buffer.data(), static_cast<std::size_t>(size)})) return;
    if (++question_->datagrams == kMaxDatagrams) finish();
  }
}

// Whether that was the answer.
bool ChronydClient::take_untrusted(std::span<const std::byte> datagram) {
  if (!answers_untrusted(datagram, question_->sequence)) {
    question_->why = Error{Errc::protocol,
                           "what it sends does not answer our question; is it "
                           "chronyd that listens there (`ss -lunp`)?"};
    return false;
  }
  const clock::Instant answered = now_();
  Result<TrackingReply> reply = tracking_untrusted(datagram);
  if (!reply) {
    question_->why = std::move(reply).error();
    return false;
  }
  finish();
  const MonoTime asked = std::exchange(question_, {})->asked;
  observer_.on_answer(*reply, asked, answered);
  return true;
}

}  // namespace dssm::daemon
