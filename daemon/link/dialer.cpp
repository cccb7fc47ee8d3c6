// SPDX-License-Identifier: Apache-2.0
//
// One round of attempts: look the address up, try the addresses in turn, greet. A round that fails,
// and a connection that ends, lead to a pause and to the next round. Everything happens in
// callbacks of the loop, and each state is left only by the timer or by the event it waits for.
#include "daemon/link/dialer.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <iterator>
#include <utility>

#include "core/base/try.hpp"
#include "core/wire/tcp.hpp"

namespace dssm::daemon {

Dialer::Dialer(const EventLoop& loop, Resolver& resolver, Options options, Observer& observer)
    : loop_(loop),
      resolver_(resolver),
      options_(std::move(options)),
      observer_(observer),
      plan_(options_.round_time),
      timer_(EventSource::timer(loop, [this] { on_timer(); })) {
  timer_.enable_in(Duration::zero());
}

// --- for the user

void Dialer::retry_now(Duration min_age) {
  stopped_ = false;
  plan_.reset_pause();
  if (state_ == State::pause) timer_.enable_in(Duration::zero());
  if (state_ == State::connect && loop_.now() - round_began_ >= min_age) begin_round_soon();
}

void Dialer::stop(const Error& why) {
  stopped_ = true;
  if (state_ == State::pause) timer_.disable();
  restart(why);
}

void Dialer::restart(const Error& why) {
  switch (state_) {
    case State::pause:
    case State::give_up:
      return;
    case State::greet:
    case State::up:
      if (!connection_->is_open()) return;  // on_closed() follows
      reason_ = why;
      given_up_ = true;
      // A channel may have been heard a little later than the control connection, whose timeout
      // ends it.
      if (loop_.now() - connection_->last_heard() >= wire::kPeerTimeout / 2) {
        connection_->discard_output_at_close();
      }
      return connection_->close_with(why);
    case State::look_up:
    case State::connect:
    case State::secure:
      given_up_ = state_ == State::secure;
      lookup_.reset();
      end_attempts();
      if (handshake_) handshake_->stop();
      reason_ = why;
      state_ = State::give_up;
      return timer_.enable_in(Duration::zero());
  }
}

void Dialer::set_addresses(std::vector<wire::Address> addresses) {
  if (addresses == options_.addresses) return;
  options_.addresses = std::move(addresses);
  if (state_ == State::connect) begin_round_soon();
}

void Dialer::on_new_credentials() {
  if (state_ == State::secure || state_ == State::greet) {
    return restart({Errc::unavailable, "the credentials of this host were replaced"});
  }
  const FrameConnection* link = connection();
  const auto credentials = wire::credentials_of(options_.self);
  if (!link || !link->peer() || !credentials) return;
  if (Result<void> checked = credentials->check(*link->peer()); !checked) restart(checked.error());
}

FrameConnection* Dialer::connection() noexcept {
  return state_ == State::up ? connection_.get() : nullptr;
}

std::string Dialer::address() const {
  return connection_ && state_ != State::pause ? plan_.address().str()
                                               : options_.addresses.front().str();
}

bool Dialer::is_insecure() const noexcept {
  return state_ == State::up && !connection_->peer() && !plan_.address().is_loopback();
}

// --- a round of attempts

// Ends an attempt to connect and begins a new round. From the timer, because the caller may be in
// the attempt's own callback.
void Dialer::begin_round_soon() {
  end_attempts();
  state_ = State::pause;
  timer_.enable_in(Duration::zero());
}

// The other side, as far as it is known.
std::string Dialer::peer_name() const {
  const std::string address = "'" + plan_.address().str() + "'";
  return them_ ? them_->str() + " (" + address + ")" : "dssmd at " + address;
}

void Dialer::begin_round() {
  connection_.reset();
  handshake_.reset();
  them_.reset();
  reason_.reset();
  round_began_ = loop_.now();
  state_ = State::look_up;
  reached_ = Phase::look_up;
  std::vector<wire::SocketAddress> numbers;
  for (const wire::Address& address : options_.addresses) {
    const std::vector<wire::SocketAddress> found = wire::resolve_number(address);
    numbers.insert(numbers.end(), found.begin(), found.end());
  }
  if (!numbers.empty()) return try_addresses(std::move(numbers));
  lookup_ = resolver_.resolve(options_.addresses.front(),
                              [this](Result<std::vector<wire::SocketAddress>> found) {
                                if (!found) return fail(found.error());
                                try_addresses(*std::move(found));
                              });
}

void Dialer::try_addresses(std::vector<wire::SocketAddress> found) {
  plan_.begin_round(std::move(found));
  try_address();
}

void Dialer::try_address() {
  attempts_.clear();
  reached_ = Phase::connect;
  if (Result<void> begun = begin_attempt(); !begun) return try_next_address(begun.error());
  state_ = State::connect;
  await_answer();
}

void Dialer::try_next_address(const Error& why) {
  plan_.next_address() ? try_address() : fail(why);
}

Result<void> Dialer::begin_attempt() {
  if (const std::string name = wire::interface_without_carrier(plan_.address()); !name.empty()) {
    return Error{Errc::unavailable,
                 fmt::format("connect to '{}': interface '{}' has no carrier; is its cable plugged "
                             "in, or its Wi-Fi connected?",
                             plan_.address().str(), name)};
  }
  UniqueFd socket = DSSM_TRY(wire::start_connect(plan_.address()));
  if (attempts_.size() == kMaxAttempts) attempts_.erase(std::next(attempts_.begin()));
  Attempt& attempt = attempts_.emplace_back();
  attempt.began = loop_.now();
  attempt.connected =
      EventSource::writable(loop_, socket.get(), [this, &attempt] { on_connected(attempt); });
  attempt.socket = std::move(socket);
  attempt.connected.enable();
  return {};
}

// Without destroying them: the caller may be in the callback of one.
void Dialer::end_attempts() {
  for (Attempt& attempt : attempts_) {
    attempt.connected.disable();
    attempt.socket.reset();
  }
}

void Dialer::await_answer() {
  const Duration left = attempts_.front().began + plan_.connect_timeout() - loop_.now();
  timer_.enable_in(std::min(left, plan_.repeat_after().value_or(left)));
}

void Dialer::on_connected(Attempt& attempt) {
  Result<void> done = wire::finish_connect(attempt.socket.get(), plan_.address());
  UniqueFd socket = std::move(attempt.socket);
  end_attempts();
  if (!done) {
    reason_ = std::move(done).error();
    // From the timer, because an attempt must not be destroyed in its callback.
    return timer_.enable_in(Duration::zero());
  }
  if (options_.retries_often) plan_.on_connected(loop_.now() - attempt.began);
  wire::set_channel_options(socket.get());
  reached_ = Phase::greet;
  if (const auto credentials = wire::credentials_of(options_.self)) {
    state_ = State::secure;
    timer_.disable();  // the handshake has its own
    handshake_ = std::make_unique<Handshake>(
        loop_, credentials, std::move(socket), ticket_, *options_.handshakes,
        [this](Result<std::unique_ptr<wire::Transport>> secured) {
          if (!secured) return fail(std::move(secured).error().context(peer_name()));
          greet(*std::move(secured));
        });
    return;
  }
  greet(wire::make_transport(std::move(socket), wire::TransportEnd::connected));
}

void Dialer::greet(std::unique_ptr<wire::Transport> transport) {
  state_ = State::greet;
  timer_.enable_in(wire::kHelloTimeout);
  FrameConnection::Observer& observer = *this;
  connection_ = std::make_unique<FrameConnection>(loop_, std::move(transport), observer,
                                                  options_.max_queued_bytes);
  net::Frame hello;
  wire::to_message(options_.self, *hello.mutable_hello());
  connection_->send(hello);
}

void Dialer::on_timer() {
  switch (state_) {
    case State::pause:
      return begin_round();
    case State::give_up:
      return fail(*std::exchange(reason_, {}));
    case State::connect:
      if (reason_) return try_next_address(*std::exchange(reason_, {}));
      if (loop_.now() - attempts_.front().began < plan_.connect_timeout()) {
        static_cast<void>(begin_attempt());  // if it fails, those that wait still count
        return await_answer();
      }
      end_attempts();
      plan_.on_no_answer();
      return try_next_address({Errc::unavailable, plan_.no_answer_text()});
    case State::greet:
      reason_ = Error{Errc::unavailable, peer_name() + " does not greet; is it a dssmd?"};
      return connection_->close_with(*reason_);
    case State::look_up:
    case State::secure:
    case State::up:
      return;
  }
}

Result<void> Dialer::on_frame(net::Frame& frame) {
  if (frame.serial() == 0 && frame.has_failure()) {
    reason_ = wire::failure(frame.failure()).context("refused by " + peer_name());
    return *reason_;
  }
  if (state_ == State::greet) return greet_untrusted(frame);
  if (frame.has_hello()) return Error{Errc::protocol, "the other side sent a second Hello"};
  return observer_.on_frame(frame);
}

Result<void> Dialer::greet_untrusted(const net::Frame& frame) {
  Result<wire::Greeting> greeting = wire::server_greeting_untrusted(frame, peer_name());
  if (greeting && connection_->peer()) {
    const Result<void> checked =
        wire::check_certified(*greeting, *connection_->peer(), wire::TransportEnd::connected);
    if (!checked) greeting = checked.error();
  }
  if (!greeting) {
    reason_ = std::move(greeting).error();
    return *reason_;
  }
  them_ = *std::move(greeting);
  timer_.disable();
  state_ = State::up;
  reached_ = Phase::up;
  plan_.on_up(loop_.now());
  observer_.on_up(*connection_, *them_);
  return {};
}

void Dialer::fail(const Error& why) {
  const bool avoid_address =
      std::exchange(given_up_, false) || state_ == State::greet || state_ == State::secure;
  state_ = State::pause;
  const Duration pause = plan_.end_round(loop_.now(), avoid_address);
  stopped_ ? timer_.disable() : timer_.enable_in(pause);
  observer_.on_down(why);
}

void Dialer::on_output_empty() {
  if (state_ == State::up) observer_.on_output_empty();
}

void Dialer::on_closed(const Error& why) {
  fail(reason_ ? *std::exchange(reason_, {}) : Error(why).context(peer_name()));
}

}  // namespace dssm::daemon
