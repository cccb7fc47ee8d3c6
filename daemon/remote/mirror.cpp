// SPDX-License-Identifier: Apache-2.0
//
// On each connection: Open, and from its answer the ring; Subscribe from what comes next in that
// ring; then samples and gaps until the connection ends.
#include "daemon/remote/mirror.hpp"

#include <fmt/format.h>

#include <utility>

#include "core/base/try.hpp"
#include "core/wire/messages.hpp"
#include "daemon/base/message_ids.hpp"

namespace dssm::daemon {
namespace {

constexpr std::uint64_t kSubscribeSerial = kOpenSerial + 1;

}  // namespace

Mirror::Mirror(const ChannelParts& parts, StreamId id, RingQuota quota,
               std::function<void()> on_done)
    : RemoteStream(parts,
                   {Purpose::mirror, message_id::kMirror,
                    "its owner's ring no longer held them when their turn came; keep more history "
                    "there, or write less than the network carries"},
                   std::move(id), std::move(quota), std::move(on_done)),
      clock_(parts.clock, id_),
      fill_timer_(EventSource::timer(parts.loop, [this] { notify_replaced(); })),
      linger_timer_(EventSource::timer(parts.loop, [this] {
        if (is_unused()) finish();
      })) {}

// --- protocol steps

void Mirror::on_up(FrameConnection& connection, const wire::Greeting& them) {
  on_owner_clock(them.clock);
  state_ = is_removed() ? State::reopening : State::opening;
  net::Frame frame;
  frame.set_serial(kOpenSerial);
  wire::to_message(id_, *frame.mutable_open()->mutable_id());
  connection.send(frame);
}

Result<void> Mirror::on_frame(net::Frame& frame) {
  switch (frame.body_case()) {
    case net::Frame::kOpened:
      return on_opened_untrusted(frame.opened());
    case net::Frame::kSubscribed:
      return on_subscribed_untrusted(frame.subscribed());
    case net::Frame::kCaughtUp:
      return on_caught_up();
    case net::Frame::kGap:
      return on_gap_untrusted(frame.gap());
    case net::Frame::kPong:
      on_owner_clock(wire::clock_report_untrusted(frame.pong()));
      return {};
    case net::Frame::kEnded:
      on_refused({Errc::not_found, "stream '" + name_ + "' was removed on its host"});
      return {};
    case net::Frame::kFailure:
      on_refused(wire::failure(frame.failure()));
      return {};
    default:
      return {};  // of a later version
  }
}

Result<void> Mirror::on_opened_untrusted(const proto::Opened& opened) {
  if (state_ != State::opening && state_ != State::reopening) return unexpected_frame("Opened");
  const StreamInfo theirs = DSSM_TRY(opened_stream_untrusted(opened, id_));
  if (Result<void> followed = follow_untrusted(theirs); !followed) {
    on_refused(followed.error());
    return {};
  }
  FrameConnection& connection = *connection_.frames();
  connection.take_samples(theirs.type.payload_bytes, *this);
  net::Frame frame;
  frame.set_serial(kSubscribeSerial);
  net::Subscribe& subscribe = *frame.mutable_subscribe();
  if (ring_->next() >= 0) {
    subscribe.set_from_tid(ring_->next());
    subscribe.set_incarnation(theirs.incarnation);
  } else {
    subscribe.set_from_oldest(true);
  }
  state_ = State::subscribing;
  connection.send(frame);
  set_pending_deadline(parts_.loop.deadline_in(kFillTimeout));
  if (!replaced_.empty()) fill_timer_.enable_in(kFillTimeout);
  return {};
}

Result<void> Mirror::on_subscribed_untrusted(const net::Subscribed& subscribed) {
  if (state_ != State::subscribing) return unexpected_frame("Subscribed");
  if (subscribed.incarnation() != ring_->stream()->incarnation()) {
    return Error{Errc::unavailable, "stream '" + name_ + "' was recreated just now"};
  }
  DSSM_TRY(ring_->on_subscribed_untrusted(subscribed.first_tid()));
  state_ = State::filling;
  last_error_.reset();
  ++subscriptions_;
  return {};
}

Result<void> Mirror::on_caught_up() {
  if (state_ < State::filling) return unexpected_frame("CaughtUp");
  if (state_ == State::filling) state_ = State::live;
  ring_->wake();
  if (clear_error()) {
    parts_.logger.notice(
        fmt::format("mirror '{}' is up to date again, at sample {}", name_, ring_->newest()),
        log_fields());
  } else {
    parts_.logger.debug(
        fmt::format("mirror '{}' is filled, up to sample {}", name_, ring_->newest()),
        log_fields());
  }
  notify_replaced();
  answer_pending(false);
  return {};
}

Result<void> Mirror::on_gap_untrusted(const net::Gap& gap) {
  if (state_ < State::filling) return unexpected_frame("Gap");
  const std::uint64_t before = ring_->gap_samples();
  DSSM_TRY(ring_->on_gap_untrusted(gap.first_tid(), gap.count()));
  log_gap(ring_->gap_samples() - before);
  return {};
}

// The ring stays for its readers. A removed stream that is created again is found by the catalog,
// or by asking the owner.
void Mirror::on_refused(const Error& why) {
  const bool removed = why.code == Errc::not_found;
  end_subscription(removed ? State::removed : State::unavailable);
  last_error_ = why;
  log_stopped();
  ring_ && !removed ? answer_pending(false) : fail_pending(why);
  connection_.reopen_later();
}

void Mirror::on_down(const Error& why) {
  last_error_ = why;
  if (!is_removed()) log_stopped();
  on_reopen();
}

void Mirror::on_reopen() { end_subscription(is_removed() ? State::removed : State::unavailable); }

void Mirror::end_subscription(State next) {
  state_ = next;
  if (ring_) ring_->wake();  // for the last samples
}

// --- what the catalog knows

void Mirror::on_stream_added() {
  if (state_ == State::ending) state_ = State::live;
  RemoteStream::on_stream_added();
}

// The channel may be earlier than the catalog, and the mirror live with the next ring.
void Mirror::on_stream_removed(std::uint64_t incarnation) {
  if (state_ != State::live && state_ != State::ending) return;
  state_ = ring_->stream()->incarnation() == incarnation ? State::ending : State::live;
}

void Mirror::on_owner_clock(MirrorClock::Report report) {
  clock_.on_owner(std::move(report), ring_ ? ring_->newest() : kNoTid);
  assess_clock();
}

void Mirror::assess_clock() {
  if (ring_ && clock_.has_report()) ring_->set_clock(clock_.assessment());
}

// --- samples

[[gnu::hot]] Result<void> Mirror::on_sample_begin(const wire::IncomingSample& sample,
                                                  std::byte*& out) {
  if (state_ < State::filling) return unexpected_frame("a sample");
  const Result<std::byte*> place = ring_->begin_untrusted(sample);
  if (!place) return place.error();
  out = *place;
  return {};
}

[[gnu::hot]] Result<void> Mirror::on_sample_end(const wire::IncomingSample& sample, bool torn) {
  const std::uint64_t before = ring_->gap_samples();
  ring_->end(sample, torn);
  if (ring_->gap_samples() != before) log_gap(ring_->gap_samples() - before);
  return {};
}

[[gnu::hot]] void Mirror::on_batch_end() {
  if (ring_) ring_->wake();
}

// --- the ring

std::shared_ptr<Stream> Mirror::stream() const noexcept {
  return ring_ ? ring_->stream() : nullptr;
}

// Makes sure that there is a ring for the owner's.
Result<void> Mirror::follow_untrusted(const StreamInfo& theirs) {
  if (ring_ && ring_->stream()->incarnation() == theirs.incarnation) {
    const Stream& ours = *ring_->stream();
    if (ours.type().payload_bytes == theirs.type.payload_bytes &&
        ours.mapping().geometry().depth == theirs.depth) {
      return {};
    }
    return Error{
        Errc::protocol,
        fmt::format("the owner of '{}' describes the same ring with another size than before",
                    name_)};
  }
  const std::string context = "mirror '" + name_ + "'";
  std::shared_ptr<Stream> stream = DSSM_TRY(Stream::create({.id = id_,
                                                            .type = theirs.type,
                                                            .depth = theirs.depth,
                                                            .cycle = theirs.cycle,
                                                            .purpose = Purpose::mirror,
                                                            .incarnation = theirs.incarnation},
                                                           parts_.registry.budget()),
                                            context);
  replace_ring(DSSM_TRY(MirrorRing::open(std::move(stream), parts_.registry.budget()), context));
  return {};
}

Result<void> Mirror::use_offered(std::shared_ptr<Stream> stream) {
  replace_ring(DSSM_TRY(MirrorRing::open(std::move(stream), parts_.registry.budget())));
  return {};
}

void Mirror::replace_ring(std::unique_ptr<MirrorRing> ring) {
  if (ring_) {
    ++restarts_;
    earlier_.gap_samples += ring_->gap_samples();
    earlier_.received_samples += ring_->received_samples();
    earlier_.received_bytes += ring_->received_bytes();
    replaced_.push_back(ring_->stream());
    parts_.logger.notice(
        fmt::format("stream '{}' has a new ring on its host: it was recreated", name_),
        log_fields());
    clock_.on_new_ring();
  }
  ring_ = std::move(ring);
  assess_clock();
}

// Only when the new ring is filled, or kFillTimeout is over: until then the old one has more.
void Mirror::notify_replaced() {
  fill_timer_.disable();
  for (const std::shared_ptr<Stream>& old : std::exchange(replaced_, {})) {
    if (parts_.on_ring_replaced) parts_.on_ring_replaced(*old);
  }
}

// --- programs

bool Mirror::can_open_now() const noexcept {
  return ring_ &&
         (state_ == State::unavailable || state_ == State::opening || state_ == State::live);
}

Duration Mirror::open_timeout() const noexcept {
  const bool is_filling = state_ == State::subscribing || state_ == State::filling;
  return is_filling ? kFillTimeout : kOwnerTimeout;
}

void Mirror::on_unused() { linger_timer_.enable_in(parts_.mirror_linger); }

void Mirror::describe(proto::Mirror& out) const {
  using Shown = proto::Mirror;
  static constexpr proto::Mirror::State kStates[] = {
      Shown::REMOVED, Shown::REMOVED, Shown::CONNECTING, Shown::CONNECTING,
      Shown::FILLING, Shown::FILLING, Shown::LIVE,       Shown::LIVE,
  };
  const bool has_lost_owner =
      ring_ && last_error_ && (state_ == State::unavailable || state_ == State::opening);
  out.set_state(has_lost_owner ? Shown::OWNER_UNAVAILABLE : kStates[static_cast<int>(state_)]);
  out.set_gap_samples(earlier_.gap_samples + (ring_ ? ring_->gap_samples() : 0));
  out.set_reconnects(subscriptions_ > 0 ? subscriptions_ - 1 : 0);
  out.set_restarts(restarts_);
  out.set_newest(ring_ ? ring_->newest() : kNoTid);
  out.set_received_samples(earlier_.received_samples + (ring_ ? ring_->received_samples() : 0));
  out.set_received_bytes(earlier_.received_bytes + (ring_ ? ring_->received_bytes() : 0));
  if (state_ < State::live && last_error_) out.set_error(last_error_->message);
  out.set_clock(clock_.reason());
}

bool Mirror::describe_stream(proto::Stream& out) const {
  if (!ring_) return false;
  wire::to_message(ring_->stream()->info(), out);
  describe(*out.mutable_mirror());
  return true;
}

void Mirror::log_stopped() {
  if (ring_) log_error(fmt::format("mirror '{}' keeps what it has", name_));
}

}  // namespace dssm::daemon
