// SPDX-License-Identifier: Apache-2.0
#include "client/src/network_connection.hpp"

#include <poll.h>
#include <unistd.h>

#include <algorithm>
#include <array>

#include "core/base/text.hpp"
#include "core/clock/clock_page.hpp"
#include "core/wire/frame.hpp"
#include "core/wire/tcp.hpp"

namespace dssm::detail {
namespace {

// For one address: longer than the kernel takes to repeat a lost first packet (1 s).
constexpr Duration kConnectTimeout = std::chrono::seconds(2);

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
  sum.slow_frames += more.slow_frames;
}

}  // namespace

NetworkConnection::NetworkConnection(wire::FrameDelegate& delegate, std::string program,
                                     Duration greeting_timeout)
    : delegate_(delegate),
      program_(std::move(program)),
      greeting_timeout_(std::max(greeting_timeout, wire::kHelloTimeout)),
      instance_id_(wire::random_number()) {}

void NetworkConnection::start(std::vector<wire::SocketAddress> addresses) {
  close();
  addresses_ = std::move(addresses);
  next_address_ = 0;
  phase_ = Phase::connecting;  // advance() does the rest
  step_deadline_ = MonoClock::now();
}

void NetworkConnection::close() {
  if (decoder_) add(earlier_, decoder_->counters());
  decoder_.reset();
  transport_.reset();
  connecting_.reset();
  queued_.clear();
  queued_from_ = 0;
  phase_ = Phase::down;
  step_deadline_ = kNever;
}

Error NetworkConnection::fail(Error why) {
  close();
  return why;
}

Error NetworkConnection::closed_error() const {
  return Error{Errc::unavailable, "dssmd at '" + address_ + "' closed the connection"};
}

// --- connecting and greeting

Result<void> NetworkConnection::connect_next() {
  Error last{Errc::no_daemon, "no address to connect to"};
  while (next_address_ < addresses_.size()) {
    const wire::SocketAddress& address = addresses_[next_address_++];
    address_ = address.str();
    auto socket = wire::start_connect(address);
    if (socket) {
      connecting_ = std::move(*socket);
      step_deadline_ = deadline_in(kConnectTimeout);
      return {};
    }
    last = std::move(socket).error();
  }
  return fail(std::move(last));
}

Result<void> NetworkConnection::greet() {
  transport_ = wire::make_transport(std::move(connecting_), wire::TransportEnd::connected);
  wire::FrameDelegate& delegate = *this;
  decoder_ = std::make_unique<wire::FrameDecoder>(delegate, wire::kMaxNetworkFrameBytes);
  wire::Greeting self;
  self.host = own_host();
  self.host_id = wire::host_id_for(self.host);
  self.instance_id = instance_id_;
  self.program = program_;
  self.version = DSSM_VERSION;
  self.features = {std::string(wire::kFeatureTorn)};
  // This program does not watch the clock, but its kernel may be the host's.
  const auto clock = std::make_shared<wire::ClockReport>();
  clock->boot_id = clock::boot_id();
  self.clock = clock;
  net::Frame frame;
  wire::to_message(self, *frame.mutable_hello());
  phase_ = Phase::greeting;
  step_deadline_ = deadline_in(greeting_timeout_);
  queue(frame);
  return send_queued();
}

[[gnu::hot]] Result<void> NetworkConnection::advance() {
  if (phase_ == Phase::down) return {};
  if (phase_ == Phase::up) return {};
  if (phase_ == Phase::connecting) {
    if (!connecting_) return connect_next();
    pollfd ready{connecting_.get(), POLLOUT, 0};
    if (::poll(&ready, 1, 0) > 0) {
      Result<void> connected =
          wire::finish_connect(connecting_.get(), addresses_[next_address_ - 1]);
      if (connected) return greet();
      connecting_.reset();
      if (next_address_ < addresses_.size()) return connect_next();
      return fail(std::move(connected).error());
    }
    if (MonoClock::now() < step_deadline_) return {};
    connecting_.reset();
    if (next_address_ < addresses_.size()) return connect_next();
    return fail(no_answer_error());
  }
  if (has_queued()) {
    if (Result<void> sent = send_queued(); !sent) return sent;
  }
  if (MonoClock::now() < step_deadline_ || has_arrived()) return {};
  return fail(no_answer_error());
}

Error NetworkConnection::no_answer_error() const {
  switch (phase_) {
    case Phase::connecting:
      return {Errc::no_daemon,
              "connect to '" + address_ +
                  "': no answer; is that PC on, and do both reach each other (`ping`)?"};
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
  return ::poll(&ready, 1, 0) > 0;
}

// --- frames

void NetworkConnection::queue(const net::Frame& frame) {
  const std::string encoded = wire::encode_frame(frame);
  queue(std::as_bytes(std::span(encoded)));
}

void NetworkConnection::queue(std::span<const std::byte> encoded) {
  if (!has_queued()) queued_.clear(), queued_from_ = 0;
  queued_.append(reinterpret_cast<const char*>(encoded.data()), encoded.size());
}

Result<void> NetworkConnection::send_queued() {
  auto sent = send_some(std::as_bytes(std::span(queued_)).subspan(queued_from_));
  if (!sent) return std::move(sent).error();
  queued_from_ += *sent;
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
  if (frame.has_failure()) return wire::failure(frame.failure()).context(who + " refuses");
  if (!frame.has_hello()) {
    return Error{Errc::protocol, who + " does not begin with a greeting; is it a dssmd?"};
  }
  auto them = wire::greeting_untrusted(frame.hello(), who);
  if (!them) return std::move(them).error();
  greeting_ = std::move(*them);
  phase_ = Phase::up;
  step_deadline_ = kNever;
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
  return transport_ ? transport_->fd() : connecting_.get();
}

short NetworkConnection::events(bool more_to_send) const noexcept {
  if (phase_ == Phase::connecting) return POLLOUT;
  return static_cast<short>(POLLIN | (has_queued() || more_to_send ? POLLOUT : 0));
}

MonoTime NetworkConnection::next_step() const noexcept { return step_deadline_; }

}  // namespace dssm::detail
