// SPDX-License-Identifier: Apache-2.0
//
// On each connection: Open, and from its answer the ring; Subscribe from what comes next in that
// ring; then samples and gaps until the connection ends.
#include "daemon/remote/mirror.hpp"

#include <algorithm>
#include <utility>

#include "core/wire/messages.hpp"
#include "daemon/base/message_ids.hpp"
#include "daemon/remote/owner_stream.hpp"

namespace dssm::daemon {
namespace {

// Serials of the two requests of a connection.
constexpr std::uint64_t kOpen = 1, kSubscribe = 2;

// A link that is too slow for its stream has gaps all the time.

}  // namespace

Mirror::Mirror(const ChannelParts& parts, Keeper& keeper, StreamId id, const Duration& linger,
               RingQuota room)
    : parts_(parts),
      keeper_(keeper),
      id_(std::move(id)),
      linger_(linger),
      room_(std::move(room)),
      clock_(parts.clock, id_),
      lender_([this] { linger_timer_.enable_in(linger_); }),
      wait_timer_(EventSource::timer(parts.loop, [this] { on_wait_timer(); })),
      linger_timer_(EventSource::timer(parts.loop, [this] { on_linger_timer(); })),
      name_(id_.str()),
      channel_(parts, name_, *this) {}

// --- the connection

void Mirror::on_up(FrameConnection& link, const wire::Greeting& them) {
  on_owner_clock(them.clock);
  step_ = Step::opening;
  net::Frame frame;
  frame.set_serial(kOpen);
  wire::to_message(id_, *frame.mutable_open()->mutable_id());
  link.send(frame);
}

void Mirror::on_down(const Error& why) {
  on_reopen();
  trouble_ = why;
  if (state_ == State::removed) return;
  state_ = ring_ ? State::owner_unavailable : State::connecting;
  if (ring_) log_error();
}

void Mirror::on_reopen() {
  step_ = Step::none;
  ending_ = false;
  if (ring_) ring_->wake();  // for what came with the end
}

void Mirror::on_stream_there() {
  ending_ = false;
  if (state_ == State::removed) channel_.try_again();
}

// The channel may be ahead, and the mirror live with the next ring.
void Mirror::on_stream_gone(std::uint64_t incarnation) {
  ending_ = state_ == State::live && ring_->stream()->incarnation() == incarnation;
}

Result<void> Mirror::on_frame(net::Frame& frame) {
  switch (frame.body_case()) {
    case net::Frame::kOpened:
      return on_opened_untrusted(frame.opened());
    case net::Frame::kSubscribed:
      return on_subscribed_untrusted(frame.subscribed());
    case net::Frame::kCaughtUp:
      if (step_ != Step::subscribed) return unexpected_frame("CaughtUp");
      on_caught_up();
      return {};
    case net::Frame::kGap:
      return on_gap_untrusted(frame.gap());
    case net::Frame::kPong:
      on_owner_clock(wire::clock_report_untrusted(frame.pong()));
      return {};
    case net::Frame::kEnded:
      on_removed({Errc::not_found, "stream '" + name_ + "' was removed on its host"});
      return {};
    case net::Frame::kFailure:
      on_refused(wire::failure(frame.failure()));
      return {};
    default:
      return {};  // of a later version
  }
}

Result<void> Mirror::on_opened_untrusted(const proto::Opened& opened) {
  if (step_ != Step::opening) return unexpected_frame("Opened");
  const Result<StreamInfo> theirs = owner_stream_untrusted(opened, id_);
  if (!theirs) return theirs.error();
  if (Result<void> followed = follow_untrusted(*theirs); !followed) {
    on_refused(followed.error());
    return {};
  }
  FrameConnection& link = *channel_.link();
  link.take_samples(theirs->type.payload_bytes, *this);
  net::Frame frame;
  frame.set_serial(kSubscribe);
  net::Subscribe& subscribe = *frame.mutable_subscribe();
  if (ring_->next() >= 0) {
    subscribe.set_from_tid(ring_->next());
    subscribe.set_incarnation(theirs->incarnation);
  } else {
    subscribe.set_from_oldest(true);
  }
  step_ = Step::subscribing;
  link.send(frame);
  state_ = State::filling;
  patience_ends_ = parts_.loop.deadline_in(kFillTimeout);
  for (Waiting& one : waiting_) one.deadline = patience_ends_;
  arm_wait_timer();
  return {};
}

// Makes sure that there is a ring for the owner's.
Result<void> Mirror::follow_untrusted(const StreamInfo& theirs) {
  if (ring_ && ring_->stream()->incarnation() == theirs.incarnation) {
    const Stream& ours = *ring_->stream();
    if (ours.type().payload_bytes == theirs.type.payload_bytes &&
        ours.mapping().geometry().depth == theirs.depth) {
      return {};
    }
    return Error{Errc::protocol, "the owner of '" + name_ +
                                     "' describes the same ring with another size than before"};
  }
  Result<std::shared_ptr<Stream>> stream = Stream::create({.id = id_,
                                                           .type = theirs.type,
                                                           .depth = theirs.depth,
                                                           .cycle = theirs.cycle,
                                                           .purpose = Purpose::mirror,
                                                           .incarnation = theirs.incarnation},
                                                          parts_.registry.budget());
  if (!stream) return std::move(stream).error().context("mirror '" + name_ + "'");
  Result<std::unique_ptr<MirrorRing>> ring =
      MirrorRing::open(*std::move(stream), parts_.registry.budget());
  if (!ring) return std::move(ring).error().context("mirror '" + name_ + "'");
  take_ring(*std::move(ring));
  return {};
}

void Mirror::take_ring(std::unique_ptr<MirrorRing> ring) {
  if (ring_) {
    ++restarts_;
    before_.gap_samples += ring_->gap_samples();
    before_.received_samples += ring_->received_samples();
    before_.received_bytes += ring_->received_bytes();
    replaced_.push_back(ring_->stream());
    parts_.logger.notice("stream '" + name_ + "' has a new ring on its host: it was created anew",
                         log_fields());
  }
  if (ring_) clock_.on_new_ring();
  ring_ = std::move(ring);
  assess();
}

void Mirror::on_owner_clock(MirrorClock::Report report) {
  clock_.on_owner(std::move(report), ring_ ? ring_->newest() : kNoTid);
  assess();
}

void Mirror::assess() {
  if (ring_ && clock_.has_report()) ring_->set_clock(clock_.assessment());
}

Result<void> Mirror::on_subscribed_untrusted(const net::Subscribed& subscribed) {
  if (step_ != Step::subscribing) return unexpected_frame("Subscribed");
  if (subscribed.incarnation() != ring_->stream()->incarnation()) {
    return Error{Errc::unavailable, "stream '" + name_ + "' was created anew just now"};
  }
  if (Result<void> begun = ring_->on_subscribed_untrusted(subscribed.first_tid()); !begun) {
    return begun;
  }
  step_ = Step::subscribed;
  trouble_.reset();
  if (std::exchange(subscribed_before_, true)) ++reconnects_;
  return {};
}

void Mirror::on_caught_up() {
  state_ = State::live;
  trouble_.reset();
  ring_->wake();
  const std::string until = "sample " + std::to_string(ring_->newest());
  if (std::exchange(told_, false)) {
    parts_.logger.notice("mirror '" + name_ + "' is up to date again, at " + until, log_fields());
  } else {
    parts_.logger.debug("mirror '" + name_ + "' is filled, up to " + until, log_fields());
  }
  notify_replaced();
  answer_waiting();
}

Result<void> Mirror::on_gap_untrusted(const net::Gap& gap) {
  if (step_ != Step::subscribed) return unexpected_frame("Gap");
  const std::uint64_t before = ring_->gap_samples();
  if (Result<void> noted = ring_->on_gap_untrusted(gap.first_tid(), gap.count()); !noted) {
    return noted;
  }
  log_gaps(ring_->gap_samples() - before);
  return {};
}

// The owner has no such stream (any more): the ring stays for its readers, and what comes of the
// name is found by the catalog or by asking.
void Mirror::on_removed(const Error& why) {
  step_ = Step::none;
  ending_ = false;
  state_ = State::removed;
  trouble_ = why;
  if (ring_) {
    ring_->wake();
    log_error();
  }
  fail_waiting(why);
  channel_.try_again_later();
}

void Mirror::on_refused(const Error& why) {
  if (why.code == Errc::not_found) return on_removed(why);
  step_ = Step::none;
  trouble_ = why;
  state_ = ring_ ? State::owner_unavailable : State::connecting;
  if (ring_) log_error();
  ring_ ? answer_waiting() : fail_waiting(why);
  channel_.try_again_later();
}

// --- samples

[[gnu::hot]] Result<void> Mirror::on_sample_begin(const wire::IncomingSample& sample,
                                                  std::byte*& out) {
  if (step_ != Step::subscribed) return unexpected_frame("a sample");
  const Result<std::byte*> place = ring_->begin_untrusted(sample);
  if (!place) return place.error();
  out = *place;
  return {};
}

[[gnu::hot]] Result<void> Mirror::on_sample_end(const wire::IncomingSample& sample, bool torn) {
  const std::uint64_t before = ring_->gap_samples();
  ring_->end(sample, torn);
  if (ring_->gap_samples() != before) log_gaps(ring_->gap_samples() - before);
  return {};
}

[[gnu::hot]] void Mirror::on_batch_end() {
  if (ring_) ring_->wake();
}

// --- programs

std::shared_ptr<Stream> Mirror::lend() {
  done_ = false;
  return lender_.lend(ring_->stream());
}

void Mirror::lend_to(const Then& then) {
  if (Result<void> good = clock_.check_opening(); !good) return then(std::move(good).error());
  then(lend());
}

std::shared_ptr<Stream> Mirror::borrow() { return ring_ ? lend() : nullptr; }

void Mirror::open(Then then) {
  // While the owner is away its history is still here.
  const bool ready = (state_ == State::live && !ending_) || state_ == State::owner_unavailable ||
                     (state_ == State::connecting && ring_);
  if (ready) {
    lend_to(then);
    return leave_if_alone(true);
  }
  done_ = false;
  const Duration longest = state_ == State::filling ? kFillTimeout : kOwnerTimeout;
  waiting_.push_back({std::move(then), parts_.loop.deadline_in(longest)});
  arm_wait_timer();
  if (state_ == State::removed) channel_.try_again();
}

Result<std::shared_ptr<Stream>> Mirror::adopt_untrusted(OfferedFiles files) {
  if (ring_) {
    if (ring_->stream()->is_ring(files.ring.get())) return lend();
    return Error{Errc::conflict, "the mirror '" + name_ +
                                     "' has another ring by now; close this one and open the "
                                     "stream anew"};
  }
  Result<std::shared_ptr<Stream>> stream =
      Stream::adopt_untrusted(std::move(files), parts_.registry.budget());
  if (!stream) return std::move(stream).error().context("mirror '" + name_ + "'");
  if ((*stream)->id() != id_ || (*stream)->purpose() != Purpose::mirror) {
    return Error{Errc::protocol, "mirror '" + name_ + "': the offered ring is that of '" +
                                     (*stream)->id().str() + "', or no mirror's"};
  }
  Result<std::unique_ptr<MirrorRing>> ring =
      MirrorRing::open(*std::move(stream), parts_.registry.budget());
  if (!ring) return std::move(ring).error().context("mirror '" + name_ + "'");
  take_ring(*std::move(ring));
  return lend();
}

void Mirror::describe(proto::Mirror& out) const {
  static constexpr proto::Mirror::State kStates[] = {
      proto::Mirror::CONNECTING, proto::Mirror::FILLING, proto::Mirror::LIVE,
      proto::Mirror::OWNER_UNAVAILABLE, proto::Mirror::REMOVED};
  out.set_state(kStates[static_cast<int>(state_)]);
  out.set_gap_samples(before_.gap_samples + (ring_ ? ring_->gap_samples() : 0));
  out.set_reconnects(reconnects_);
  out.set_restarts(restarts_);
  out.set_newest(ring_ ? ring_->newest() : kNoTid);
  out.set_received_samples(before_.received_samples + (ring_ ? ring_->received_samples() : 0));
  out.set_received_bytes(before_.received_bytes + (ring_ ? ring_->received_bytes() : 0));
  if (state_ != State::live && trouble_) out.set_error(trouble_->message);
  out.set_clock(clock_.reason());
}

void Mirror::answer_waiting() {
  const std::vector<Waiting> all = std::exchange(waiting_, {});
  for (const Waiting& one : all) lend_to(one.then);
  arm_wait_timer();
  leave_if_alone(!all.empty());
}

void Mirror::fail_waiting(const Error& why) {
  const std::vector<Waiting> all = std::exchange(waiting_, {});
  for (const Waiting& one : all) one.then(why);
  arm_wait_timer();
  leave_if_alone(!all.empty());
}

// somebody_left: just now, without the ring.
void Mirror::leave_if_alone(bool somebody_left) {
  if (lender_.any_lent() || !waiting_.empty()) return;
  if (!ring_) {
    done_ = true;
    keeper_.on_mirror_done();
  } else if (somebody_left) {
    linger_timer_.enable_in(linger_);
  }
}

void Mirror::arm_wait_timer() {
  if (waiting_.empty() && replaced_.empty()) return wait_timer_.disable();
  MonoTime first = replaced_.empty() ? kNever : patience_ends_;
  for (const Waiting& one : waiting_) first = std::min(first, one.deadline);
  wait_timer_.enable_in(std::max(first - parts_.loop.now(), Duration::zero()));
}

// What has come by now has to do; those who came later may wait longer.
void Mirror::on_wait_timer() {
  const MonoTime now = parts_.loop.now();
  if (now >= patience_ends_) notify_replaced();
  const auto later = std::stable_partition(
      waiting_.begin(), waiting_.end(), [now](const Waiting& one) { return one.deadline <= now; });
  const std::vector<Waiting> overdue(waiting_.begin(), later);
  waiting_.erase(waiting_.begin(), later);
  for (const Waiting& one : overdue) {
    if (ring_ && state_ != State::removed) {
      lend_to(one.then);
    } else {
      one.then(away());
    }
  }
  leave_if_alone(!overdue.empty());
  arm_wait_timer();
}

Error Mirror::away() const {
  return Error{Errc::unavailable, "stream '" + name_ + "': host '" + id_.host +
                                      "' does not answer at '" + channel_.address().str() + "'" +
                                      (trouble_ ? ": " + trouble_->message : "") +
                                      "; look at `dssmctl hosts`, and try again"};
}

// Only once there is something to read in the new ring: until then the old one is the better.
void Mirror::notify_replaced() {
  for (const std::shared_ptr<Stream>& old : std::exchange(replaced_, {})) {
    keeper_.on_ring_replaced(*old);
  }
}

void Mirror::on_linger_timer() {
  if (lender_.any_lent() || !waiting_.empty()) return;
  done_ = true;
  keeper_.on_mirror_done();
}

// --- the log

LogFields Mirror::log_fields() const {
  return {.stream = name_, .peer = id_.host, .message_id = message_id::kMirror};
}

// Once, not at each attempt.
void Mirror::log_error() {
  if (std::exchange(told_, true)) return;
  parts_.logger.notice(
      "mirror '" + name_ + "' stays as it is: " + trouble_->message + "; trying again",
      log_fields());
}

void Mirror::log_gaps(std::uint64_t samples) {
  const auto unlogged = gap_lines_.admit(parts_.loop.now(), samples);
  if (!unlogged) return;
  parts_.logger.warning(
      "mirror '" + name_ + "' lacks " + std::to_string(*unlogged) +
          " samples, which its owner's ring no longer held when their turn came; keep more history "
          "there, or write less than the link carries",
      log_fields());
}

}  // namespace dssm::daemon
