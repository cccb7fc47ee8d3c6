// SPDX-License-Identifier: Apache-2.0
#include "daemon/fleet/peer_connection.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <utility>

#include "daemon/base/memory_budget.hpp"

namespace dssm::daemon {
namespace {

// A frame that we send is no larger than a property and its stream's name.
constexpr std::size_t kMaxOutputBytes = PeerConnection::kMaxWaitingBytes + (2U << 20);

// The peer timeout while bytes of ours wait for the peer's kernel to take them: a large property on
// a slow network delays our heartbeats. Whether the peer's PC is alive is then observed by our
// kernel (TCP_USER_TIMEOUT); this bounds how long its dssmd may hang.
constexpr Duration kPeerTimeoutWithOutput = 10 * wire::kPeerTimeout;

// The peer answers, but retries do not help until something is changed there.
bool is_refusal(const Error& error) noexcept {
  return error.code == Errc::protocol || error.code == Errc::conflict ||
         error.code == Errc::no_permission || error.code == Errc::limit_exceeded ||
         error.code == Errc::invalid_argument;
}

HostReason reason_of(const Error& error, Dialer::Phase reached) noexcept {
  if (is_refusal(error)) return HostReason::not_accepted;
  switch (reached) {
    case Dialer::Phase::look_up:
      return HostReason::name_not_found;
    case Dialer::Phase::greet:
      return HostReason::no_greeting;
    case Dialer::Phase::connect:
    case Dialer::Phase::up:
      break;
  }
  return error.code == Errc::no_daemon ? HostReason::connection_refused : HostReason::no_answer;
}

}  // namespace

PeerConnection::PeerConnection(const EventLoop& loop, Resolver& resolver,
                               std::optional<wire::HostId> expected, Dialer::Options options,
                               Observer& observer)
    : loop_(loop),
      configured_(options.addresses.front()),
      expected_(expected),
      self_(options.self),
      observer_(observer),
      status_{.since = loop.now()},
      heartbeat_(EventSource::timer(loop, [this] { beat(); })),
      dialer_(loop, resolver, std::move(options), *this) {}

PeerConnection::PeerConnection(const EventLoop& loop, Resolver& resolver, const wire::Address& peer,
                               const wire::Greeting& self, HandshakeBudget* handshakes,
                               Observer& observer)
    : PeerConnection(loop, resolver, std::nullopt,
                     {.addresses = {peer},
                      .self = self,
                      .handshakes = handshakes,
                      .max_queued_bytes = kMaxOutputBytes,
                      .retries_often = true},
                     observer) {}

PeerConnection::PeerConnection(const EventLoop& loop, Resolver& resolver, const wire::HostId& id,
                               const std::vector<wire::Address>& addresses,
                               const wire::Greeting& self, HandshakeBudget* handshakes,
                               Observer& observer)
    : PeerConnection(loop, resolver, id,
                     {.addresses = addresses,
                      .self = self,
                      .handshakes = handshakes,
                      .max_queued_bytes = kMaxOutputBytes,
                      .round_time = kFoundRoundTime,
                      .retries_often = true},
                     observer) {}

bool PeerConnection::is_at(const wire::IpAddress& address) const {
  const std::vector<wire::SocketAddress>& found = dialer_.found_addresses();
  return std::any_of(found.begin(), found.end(), [&](const wire::SocketAddress& one) {
    return wire::IpAddress::of(one) == address;
  });
}

void PeerConnection::set_addresses(const std::vector<wire::Address>& addresses) {
  configured_ = addresses.front();
  dialer_.set_addresses(addresses);
  if (status_.state != HostState::up) dialer_.retry_now();
}

void PeerConnection::on_network_changed() {
  if (status_.state != HostState::up) dialer_.retry_now(Dialer::kMinRound);
}

void PeerConnection::enter(HostState state, HostReason reason, std::optional<Error> error) {
  const MonoTime since = state == status_.state ? status_.since : loop_.now();
  status_ = {state, reason, since, std::move(error)};
}

void PeerConnection::on_up(FrameConnection& connection, const wire::Greeting& them) {
  if (expected_ && them.host_id != *expected_) {
    return dialer_.restart({Errc::conflict, fmt::format("{} answers at '{}', not the host that is "
                                                        "announced there",
                                                        them.str(), address())});
  }
  them_ = them;
  connection.stamp_arrivals();
  enter(HostState::up, HostReason::none, std::nullopt);
  observer_.on_peer_up(*this);
}

void PeerConnection::on_down(const Error& error) {
  const bool attempt = status_.state != HostState::up;
  heartbeat_.disable();
  beat_at_ = {};
  watching_ = false;
  round_trips_ = {};
  carried_bytes_per_s_ = 0;
  enter(is_refusal(error) ? HostState::refused : HostState::down,
        reason_of(error, dialer_.reached()), error);
  const std::map<std::uint64_t, Waiting> unanswered = std::exchange(requests_.waiting, {});
  requests_.bytes = 0;
  // First, so that those who wait find the host down, and can answer from what is known here.
  observer_.on_peer_down(*this, error, attempt);
  for (const auto& [serial, waiting] : unanswered) {
    answer_with(waiting.then, [&]() -> Result<net::Frame> {
      return Error{Errc::unavailable,
                   fmt::format("the connection to host '{}' ended before it answered: {}",
                               them_ ? them_->host : configured_.str(), error.message)};
    });
  }
}

void PeerConnection::ask(net::Frame request, Then then) {
  const bool is_full = requests_.waiting.size() >= kMaxWaiting ||
                       requests_.bytes + request.ByteSizeLong() > kMaxWaitingBytes;
  if (is_full && dialer_.connection()) {
    return then(Error{Errc::limit_exceeded,
                      fmt::format("host '{}' has not answered {} requests of this host's programs "
                                  "yet; retry in a second",
                                  them_->host, requests_.waiting.size())});
  }
  send(std::move(request), std::move(then));
}

void PeerConnection::send(net::Frame request, Then then) {
  FrameConnection* link = dialer_.connection();
  if (!link || !link->is_open()) {
    return then(
        Error{Errc::unavailable, "the host at '" + address() + "' is not connected any more"});
  }
  const std::size_t bytes = request.ByteSizeLong();
  request.set_serial(requests_.next_serial++);
  requests_.bytes += bytes;
  requests_.waiting.emplace(request.serial(), Waiting{std::move(then), bytes});
  link->send(request);
}

Result<void> PeerConnection::on_frame(net::Frame& frame) {
  if (frame.serial() != 0) {
    auto waiting = requests_.waiting.extract(frame.serial());
    if (!waiting) return Error{Errc::protocol, "it sends a response without a request"};
    requests_.bytes -= waiting.mapped().bytes;
    if (frame.has_failure()) {
      waiting.mapped().then(wire::failure(frame.failure()));
    } else {
      waiting.mapped().then(std::move(frame));
    }
    return {};
  }
  if (frame.has_stream_event() && watching_) {
    return observer_.on_stream_event_untrusted(*this, frame.stream_event());
  }
  if (frame.has_pong()) take_clock(wire::clock_report_untrusted(frame.pong()));
  return {};  // an event of a later version
}

void PeerConnection::watch() {
  watching_ = true;
  net::Frame request;
  request.mutable_watch();
  ask(std::move(request), [this](const Result<net::Frame>& answer) {
    if (answer) return observer_.on_watched(*this);
    // The peer refuses: without its streams it is of no use. (When the connection broke, no
    // effect.)
    drop(Error(answer.error()).context("watch the streams of host '" + them_->host + "'"));
  });
}

void PeerConnection::start_heartbeat() {
  answered_ = {};
  beat();
}

void PeerConnection::on_their_heartbeat() {
  their_beat_at_ = loop_.now();
  if (beat_at_ == MonoTime() || their_beat_at_ - beat_at_ < wire::kHeartbeat / 2) return;
  follows_theirs_ = true;
  heartbeat_.enable_in(Duration::zero());  // after theirs was answered
}

// Called every kHeartbeat, or when the peer timeout is over, whichever is first. This is where a
// peer that does not answer any more counts as dead (peers.hpp).
void PeerConnection::beat() {
  FrameConnection* link = dialer_.connection();
  if (!link) return;
  const MonoTime now = loop_.now();
  const Duration silent = now - link->last_heard();
  const Duration timeout = link->output_empty() ? wire::kPeerTimeout : kPeerTimeoutWithOutput;
  if (silent >= timeout) {
    return dialer_.restart(
        {Errc::unavailable,
         fmt::format("no bytes came from host '{}' ('{}') for {} ms", them_->host, address(),
                     std::chrono::duration_cast<std::chrono::milliseconds>(silent).count())});
  }
  beat_at_ = now;
  is_repeatable_ = !follows_theirs_;
  ping();
  const Duration next = std::exchange(follows_theirs_, false) ? kFollow : wire::kHeartbeat;
  heartbeat_.enable_in(std::min(next, timeout - silent));
}

void PeerConnection::ping() {
  net::Frame request;
  net::Ping& ping = *request.mutable_ping();
  wire::send_clock(self_, *ping.mutable_clock());
  ping.set_answered_ns(to_ns(std::exchange(answered_, {})));
  asked_ = RawClock::now();
  ping.set_raw_ns(to_ns(asked_));
  send(std::move(request), [this, now = loop_.now(), asked = asked_](
                               const Result<net::Frame>& answer) { on_pong(now, asked, answer); });
}

void PeerConnection::take_clock(std::shared_ptr<const wire::ClockReport> clock) {
  them_->clock = std::move(clock);
  observer_.on_heartbeat(*this);
}

void PeerConnection::on_pong(MonoTime asked, RawTime asked_raw, const Result<net::Frame>& answer) {
  const RawTime answered = arrival(RawClock::now());
  if (!answer || !answer->has_pong()) return;
  if (asked_raw == asked_) answered_ = answered;  // else the next heartbeat is under way already
  const Duration took = loop_.now() - asked;
  const Duration min = round_trips_.min;
  round_trips_ = {took, min == Duration::zero() ? took : std::min(min, took)};
  carried_bytes_per_s_ = answer->pong().carried_bytes_per_s();
  if (!answer->pong().has_clock()) return;
  wire::ClockReport clock = wire::clock_report_untrusted(answer->pong().clock(), asked);
  const net::Pong& pong = answer->pong();
  const std::int64_t received_ns = pong.received_ns() ? pong.received_ns() : pong.raw_ns();
  clock.heartbeat = {asked_raw, RawTime(Duration(received_ns)), RawTime(Duration(pong.raw_ns())),
                     answered};
  take_clock(std::make_shared<const wire::ClockReport>(std::move(clock)));
  const MonoTime now = loop_.now();
  const bool do_they_beat = now - their_beat_at_ <= wire::kHeartbeat * 3 / 2;
  const bool is_late = took > round_trips_.min * 5 / 4;
  if (std::exchange(is_repeatable_, false) && do_they_beat && is_late &&
      now - repeated_at_ >= kRepeat && dialer_.connection()) {
    repeated_at_ = now;
    ping();
  }
}

// When what was read at `read` came.
RawTime PeerConnection::arrival(RawTime read) {
  const FrameConnection* link = dialer_.connection();
  return link && self_.clock ? self_.clock->line.arrival(link->arrived(), read) : read;
}

}  // namespace dssm::daemon
