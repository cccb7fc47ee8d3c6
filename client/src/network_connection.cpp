// SPDX-License-Identifier: Apache-2.0
#include "client/src/network_connection.hpp"

#include <poll.h>
#include <sys/epoll.h>
#include <sys/timerfd.h>
#include <unistd.h>

#include <algorithm>
#include <array>

#include "core/base/text.hpp"
#include "core/base/time.hpp"
#include "core/base/try.hpp"
#include "core/clock/clock_page.hpp"
#include "core/wire/frame.hpp"
#include "core/wire/tcp.hpp"

namespace dssm::detail {
namespace {

// This PC's name as a greeting wants it: letters, digits and '-'.
std::string own_host() {
  std::array<char, 256> text{};
  ::gethostname(text.data(), text.size() - 1);
  std::string name(text.data());
  name.resize(std::min({name.find('.'), name.size(), kMaxHostBytes}));
  for (char& c : name) {
    if (!is_letter_or_digit(c)) c = '-';
  }
  return name.empty() ? "unnamed" : name;
}

void add(wire::DecoderCounters& sum, const wire::DecoderCounters& more) noexcept {
  sum.samples += more.samples;
  sum.copied_payload_bytes += more.copied_payload_bytes;
  sum.direct_payload_bytes += more.direct_payload_bytes;
}

}  // namespace

NetworkConnection::NetworkConnection(wire::FrameDelegate& delegate, std::string program,
                                     Duration greeting_timeout, ClientCredentials credentials)
    : delegate_(delegate),
      program_(std::move(program)),
      greeting_timeout_(greeting_timeout),
      instance_id_(wire::random_number()),
      credentials_(std::move(credentials)) {}

Result<void> NetworkConnection::start(Result<std::vector<wire::SocketAddress>> addresses) {
  phase_ = Phase::connecting;
  if (!addresses) return fail(std::move(addresses).error());
  plan_.begin_round(*std::move(addresses));
  return connect();
}

void NetworkConnection::close() {
  if (phase_ == Phase::down) return;
  const MonoTime now = MonoClock::now();
  step_at_ = now + plan_.end_round(now, phase_ == Phase::securing || phase_ == Phase::greeting);
  phase_ = Phase::down;
  if (decoder_) add(earlier_, decoder_->counters());
  decoder_.reset();
  transport_.reset();
  handshake_.reset();
  connecting_.reset();
  queued_.clear();
  queued_from_ = 0;
}

Error NetworkConnection::fail(Error why) {
  close();
  return why;
}

Error NetworkConnection::closed_error() const {
  return Error{Errc::unavailable, "dssmd at '" + address_ + "' closed the connection"};
}

// --- connecting and greeting

Result<void> NetworkConnection::connect() {
  address_ = plan_.address().str();
  auto socket = wire::start_connect(plan_.address());
  if (!socket) return connect_next(std::move(socket).error());
  connecting_ = std::move(*socket);
  step_at_ = deadline_in(plan_.connect_timeout());
  return {};
}

Result<void> NetworkConnection::connect_next(Error why) {
  connecting_.reset();
  return plan_.next_address() ? connect() : fail(std::move(why));
}

// The socket is connected.
Result<void> NetworkConnection::begin() {
  // step_at_ is when it would have timed out.
  plan_.on_connected(plan_.connect_timeout() - (step_at_ - MonoClock::now()));
  std::unique_ptr<wire::Transport> transport =
      wire::make_transport(std::move(connecting_), wire::TransportEnd::connected);
  step_at_ = deadline_in(greeting_timeout_);
  credentials_.refresh();
  const auto credentials = credentials_.for_address(plan_.address());
  if (!credentials) return greet(std::move(transport));
  phase_ = Phase::securing;
  handshake_.emplace(credentials, std::move(transport), wire::TransportEnd::connected, &ticket_);
  return secure();
}

Result<void> NetworkConnection::secure() {
  const Result<bool> done = handshake_->go_on();
  if (!done) return fail(Error(done.error()).context("dssmd at '" + address_ + "'"));
  if (*done) return greet(handshake_->take_transport());
  return MonoClock::now() < step_at_ ? Result<void>() : fail(no_answer_error());
}

Result<void> NetworkConnection::greet(std::unique_ptr<wire::Transport> transport) {
  transport_ = std::move(transport);
  handshake_.reset();
  wire::FrameDelegate& delegate = *this;
  decoder_ = std::make_unique<wire::FrameDecoder>(delegate, wire::kMaxNetworkFrameBytes);
  wire::Greeting self;
  self.host = own_host();
  self.host_id = wire::host_id_for(self.host);
  self.instance_id = instance_id_;
  self.program = program_;
  self.version = DSSM_VERSION;
  self.pid = ::getpid();
  self.features = {std::string(wire::kFeatureTorn)};
  // This program does not watch the clock, but its kernel may be the host's.
  const auto clock = std::make_shared<wire::ClockReport>();
  clock->boot_id = clock::boot_id();
  self.clock = clock;
  net::Frame frame;
  wire::to_message(self, *frame.mutable_hello());
  phase_ = Phase::greeting;
  queue(frame);
  return send_queued();
}

[[gnu::hot]] Result<void> NetworkConnection::advance() {
  if (phase_ == Phase::down || phase_ == Phase::up) return {};
  if (phase_ == Phase::connecting) {
    pollfd ready{connecting_.get(), POLLOUT, 0};
    if (::poll(&ready, 1, 0) > 0) {
      Result<void> connected = wire::finish_connect(connecting_.get(), plan_.address());
      return connected ? begin() : connect_next(std::move(connected).error());
    }
    return MonoClock::now() < step_at_ ? Result<void>() : connect_next(no_answer_error());
  }
  if (phase_ == Phase::securing) return secure();
  if (has_queued()) DSSM_TRY(send_queued());
  if (MonoClock::now() < step_at_ || has_arrived()) return {};
  return fail(no_answer_error());
}

Error NetworkConnection::no_answer_error() const {
  switch (phase_) {
    case Phase::connecting:
      return {Errc::no_daemon, plan_.no_answer_text()};
    case Phase::securing:
    case Phase::greeting:
      return {Errc::unavailable,
              "what listens at '" + address_ + "' does not greet; is it a dssmd?"};
    case Phase::down:
    case Phase::up:
      break;
  }
  return {Errc::unavailable, "dssmd at '" + address_ + "' does not answer"};
}

bool NetworkConnection::has_arrived() const noexcept {
  pollfd ready{fd(), POLLIN, 0};
  return has_buffered_input() || ::poll(&ready, 1, 0) > 0;
}

// --- frames

void NetworkConnection::queue(const net::Frame& frame) {
  const std::string encoded = wire::encode_frame(frame);
  queue(std::as_bytes(std::span(encoded)));
}

void NetworkConnection::queue(std::span<const std::byte> encoded) {
  if (queued_from_ == queued_.size()) queued_.clear(), queued_from_ = 0;
  queued_.append(reinterpret_cast<const char*>(encoded.data()), encoded.size());
}

Result<void> NetworkConnection::send_queued() {
  if (const Result<wire::IoStatus> flushed = transport_->flush(); !flushed) {
    return fail(flushed.error());
  }
  queued_from_ += DSSM_TRY(send_some(std::as_bytes(std::span(queued_)).subspan(queued_from_)));
  return {};
}

Result<std::size_t> NetworkConnection::send_some(std::span<const std::byte> bytes) {
  std::size_t sent = 0;
  while (sent < bytes.size()) {
    const iovec part{const_cast<std::byte*>(bytes.data()) + sent, bytes.size() - sent};
    auto result = transport_->send({&part, 1});
    if (!result) return fail(std::move(result).error());
    // Closed: a final failure may be there to be read, and then the end.
    if (result->status != wire::IoStatus::ok) break;
    sent += result->bytes;
  }
  return sent;
}

[[gnu::hot]] Result<wire::IoStatus> NetworkConnection::receive() {
  if (!transport_) return wire::IoStatus::would_block;
  return on_received(transport_->receive(decoder_->spaces()));
}

[[gnu::hot]] Result<wire::IoStatus> NetworkConnection::receive_waiting() {
  if (!transport_) return wire::IoStatus::would_block;
  return on_received(transport_->receive_waiting(decoder_->spaces()));
}

[[gnu::hot]] Result<wire::IoStatus> NetworkConnection::receive_spinning() {
  if (!transport_) return wire::IoStatus::would_block;
  return on_received(spin_budget_.receive(*transport_, decoder_->spaces()));
}

[[gnu::hot]] Result<wire::IoStatus> NetworkConnection::on_received(
    const Result<wire::IoResult>& received) {
  if (!received) return fail(received.error());
  if (received->status == wire::IoStatus::end) return fail(closed_error());
  if (received->status != wire::IoStatus::ok) return received->status;
  spin_budget_.on_received(received->bytes);
  if (Result<void> done = decoder_->commit(received->bytes); !done) {
    return fail(std::move(done).error());
  }
  return wire::IoStatus::ok;
}

Result<void> NetworkConnection::resume() {
  if (!decoder_) return {};
  if (Result<void> done = decoder_->commit(0); !done) return fail(std::move(done).error());
  return {};
}

Result<void> NetworkConnection::on_frame(net::Frame& frame) {
  if (phase_ == Phase::up) return delegate_.on_frame(frame);
  const std::string who = "dssmd at '" + address_ + "'";
  const wire::Greeting them = DSSM_TRY(wire::server_greeting_untrusted(frame, who));
  if (transport_->peer()) {
    DSSM_TRY(wire::check_certified(them, *transport_->peer(), wire::TransportEnd::connected), who);
  }
  phase_ = Phase::up;
  plan_.on_up(MonoClock::now());
  step_at_ = kNever;
  return {};
}

[[gnu::hot]] Result<void> NetworkConnection::on_sample_begin(const wire::IncomingSample& sample,
                                                             std::byte*& out) {
  return delegate_.on_sample_begin(sample, out);  // refused by the decoder before a size is set
}

[[gnu::hot]] Result<void> NetworkConnection::on_sample_end(const wire::IncomingSample& sample,
                                                           bool torn) {
  return delegate_.on_sample_end(sample, torn);
}

wire::DecoderCounters NetworkConnection::counters() const noexcept {
  wire::DecoderCounters sum = earlier_;
  if (decoder_) add(sum, decoder_->counters());
  return sum;
}

// --- waiting

int NetworkConnection::fd() const noexcept {
  if (handshake_) return handshake_->fd();
  return transport_ ? transport_->fd() : connecting_.get();
}

short NetworkConnection::events(bool more_to_send) const noexcept {
  if (phase_ == Phase::connecting) return POLLOUT;
  if (phase_ == Phase::securing) return handshake_->events();
  return static_cast<short>(POLLIN | (has_queued() || more_to_send ? POLLOUT : 0));
}

bool NetworkConnection::make_epoll() noexcept {
  if (epoll_) return true;
  UniqueFd epoll(::epoll_create1(EPOLL_CLOEXEC));
  timer_.reset(::timerfd_create(CLOCK_MONOTONIC, TFD_CLOEXEC | TFD_NONBLOCK));
  epoll_event event{};
  event.events = EPOLLIN;
  event.data.fd = timer_.get();
  if (!epoll || !timer_ || ::epoll_ctl(epoll.get(), EPOLL_CTL_ADD, timer_.get(), &event)) {
    return false;
  }
  epoll_ = std::move(epoll);
  return true;
}

int NetworkConnection::ready_fd(bool more_to_send, MonoTime at) noexcept {
  if (!make_epoll()) return fd();
  // The socket may be another one with the number of the last: a closed one leaves the set by
  // itself.
  if (fd() >= 0) {
    epoll_event event{};
    event.events = static_cast<std::uint32_t>(events(more_to_send));  // poll's bits are epoll's
    event.data.fd = fd();
    if (::epoll_ctl(epoll_.get(), EPOLL_CTL_MOD, fd(), &event)) {
      ::epoll_ctl(epoll_.get(), EPOLL_CTL_ADD, fd(), &event);
    }
  }
  if (has_buffered_input()) at = MonoTime::min();
  itimerspec timer{};  // all 0: off
  if (at != kNever) timer.it_value = timespec_of(std::max(at, MonoTime(Duration(1))));
  ::timerfd_settime(timer_.get(), TFD_TIMER_ABSTIME, &timer, nullptr);
  return epoll_.get();
}

}  // namespace dssm::detail
