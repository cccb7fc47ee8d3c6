// SPDX-License-Identifier: Apache-2.0
#include "daemon/fleet/peer_connection.hpp"

#include <algorithm>
#include <utility>

namespace dssm::daemon {
namespace {

// A frame that we send is no larger than a property and its stream's name.
constexpr std::size_t kMaxOutputBytes = PeerConnection::kMaxWaitingBytes + (2U << 20);

// Silence while bytes of ours still wait for the peer's kernel to take them: a large property on a
// slow network keeps our heartbeats from going out. Whether the peer's PC is alive is then watched
// by our kernel (TCP_USER_TIMEOUT); this bounds how long its dssmd may hang.
constexpr Duration kSilenceBehindOutput = 10 * wire::kPeerTimeout;

// It is there, but will not do before somebody changes something.
bool is_refusal(const Error& why) noexcept {
  return why.code == Errc::protocol || why.code == Errc::conflict ||
         why.code == Errc::no_permission || why.code == Errc::limit_exceeded ||
         why.code == Errc::invalid_argument;
}

}  // namespace

std::string_view state_name(PeerConnection::State state) noexcept {
  switch (state) {
    case PeerConnection::State::connecting:
      return "connecting";
    case PeerConnection::State::up:
      return "up";
    case PeerConnection::State::down:
      return "down";
    case PeerConnection::State::refused:
      return "refused";
  }
  return "";
}

PeerConnection::PeerConnection(const EventLoop& loop, Resolver& resolver,
                               std::optional<wire::HostId> expected, Dialer::Options options,
                               Observer& observer)
    : loop_(loop),
      configured_(options.addresses.front()),
      expected_(expected),
      self_(options.self),
      observer_(observer),
      heartbeat_(EventSource::timer(loop, [this] { beat(); })),
      dialer_(loop, resolver, std::move(options), *this) {}

PeerConnection::PeerConnection(const EventLoop& loop, Resolver& resolver, const wire::Address& peer,
                               const wire::Greeting& self, Observer& observer)
    : PeerConnection(loop, resolver, std::nullopt, {{peer}, self, kMaxOutputBytes}, observer) {}

PeerConnection::PeerConnection(const EventLoop& loop, Resolver& resolver, const wire::HostId& id,
                               const std::vector<wire::Address>& addresses,
                               const wire::Greeting& self, Observer& observer)
    : PeerConnection(loop, resolver, id,
                     {addresses, self, kMaxOutputBytes, kFoundPause, kFoundRoundTime}, observer) {}

void PeerConnection::set_addresses(const std::vector<wire::Address>& addresses) {
  configured_ = addresses.front();
  dialer_.set_addresses(addresses);
  if (state_ != State::up) dialer_.retry_now();
}

void PeerConnection::enter(State state, std::optional<Error> why) {
  if (state != state_) since_ = loop_.now();
  state_ = state;
  why_ = std::move(why);
}

void PeerConnection::on_up(FrameConnection&, const wire::Greeting& them) {
  if (expected_ && them.host_id != *expected_) {
    return dialer_.restart({Errc::conflict, "at '" + address() + "' answers " + them.str() +
                                                ", which is another one than was found there"});
  }
  them_ = them;
  enter(State::up, std::nullopt);
  observer_.on_link_up(*this);
}

void PeerConnection::on_down(const Error& why) {
  const bool attempt = state_ != State::up;
  heartbeat_.disable();
  watching_ = false;
  last_round_trip_ = least_round_trip_ = Duration::zero();
  enter(is_refusal(why) ? State::refused : State::down, why);
  const std::map<std::uint64_t, Waiting> unanswered = std::exchange(waiting_, {});
  waiting_bytes_ = 0;
  for (const auto& [serial, waiting] : unanswered) {
    waiting.then(Error{Errc::unavailable, "host '" + (them_ ? them_->host : configured_.str()) +
                                              "' went away before it answered: " + why.message});
  }
  observer_.on_link_down(*this, why, attempt);
}

void PeerConnection::ask(net::Frame request, Then then) {
  FrameConnection* link = dialer_.link();
  if (!link || !link->is_open()) {
    return then(Error{Errc::unavailable, "host at '" + address() + "' does not answer any more"});
  }
  const std::size_t bytes = request.ByteSizeLong();
  if (waiting_.size() >= kMaxWaiting || waiting_bytes_ + bytes > kMaxWaitingBytes) {
    return then(Error{Errc::limit_exceeded,
                      "host '" + them_->host + "' has not answered " +
                          std::to_string(waiting_.size()) +
                          " requests of this host's programs yet; ask again in a second"});
  }
  request.set_serial(next_serial_++);
  waiting_bytes_ += bytes;
  waiting_.emplace(request.serial(), Waiting{std::move(then), bytes});
  link->send(request);
}

Result<void> PeerConnection::on_frame(net::Frame& frame) {
  if (frame.serial() != 0) {
    auto waiting = waiting_.extract(frame.serial());
    if (!waiting) return Error{Errc::protocol, "it answers what nobody asked"};
    waiting_bytes_ -= waiting.mapped().bytes;
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
    // Words of the peer: without its streams it is of no use. (When the connection broke, nothing.)
    drop(Error(answer.error()).context("watch the streams of host '" + them_->host + "'"));
  });
}

void PeerConnection::keep_alive() { beat(); }

// Comes every kHeartbeat, or when the silence has lasted too long, whichever is first.
void PeerConnection::beat() {
  FrameConnection* link = dialer_.link();
  if (!link) return;
  const MonoTime now = loop_.now();
  const Duration silence = now - link->last_heard();
  const Duration allowed = link->output_empty() ? wire::kPeerTimeout : kSilenceBehindOutput;
  if (silence >= allowed) {
    return dialer_.restart(
        {Errc::unavailable,
         "no sign of life from host '" + them_->host + "' ('" + address() + "') for " +
             std::to_string(
                 std::chrono::duration_cast<std::chrono::milliseconds>(silence).count()) +
             " ms"});
  }
  net::Frame request;
  wire::send_clock(self_, *request.mutable_ping()->mutable_clock());
  ask(std::move(request), [this, now](const Result<net::Frame>& answer) { on_pong(now, answer); });
  heartbeat_.enable_in(std::min(wire::kHeartbeat, allowed - silence));
}

void PeerConnection::take_clock(std::shared_ptr<const wire::ClockReport> clock) {
  them_->clock = std::move(clock);
  observer_.on_heartbeat(*this);
}

void PeerConnection::on_pong(MonoTime asked, const Result<net::Frame>& answer) {
  if (!answer || !answer->has_pong()) return;
  last_round_trip_ = loop_.now() - asked;
  least_round_trip_ = least_round_trip_ == Duration::zero()
                          ? last_round_trip_
                          : std::min(least_round_trip_, last_round_trip_);
  if (!answer->pong().has_clock()) return;
  take_clock(std::make_shared<const wire::ClockReport>(
      wire::clock_report_untrusted(answer->pong().clock(), asked)));
}

}  // namespace dssm::daemon
