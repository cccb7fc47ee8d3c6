// SPDX-License-Identifier: Apache-2.0
//
// On each connection: Open or Create; StartPublishing, whose answer tells where the owner stopped;
// then samples, as they come, until the connection ends.
#include "daemon/remote/remote_writer.hpp"

#include <algorithm>
#include <utility>

#include "core/wire/messages.hpp"
#include "daemon/base/message_ids.hpp"
#include "daemon/remote/owner_stream.hpp"

namespace dssm::daemon {
namespace {

constexpr std::uint64_t kOpenSerial = 1, kStartSerial = 2;

// A link that is too slow for its writer loses samples all the time.

}  // namespace

RemoteWriter::RemoteWriter(const ChannelParts& parts, Keeper& keeper, StreamId id, RingQuota room)
    : parts_(parts),
      keeper_(keeper),
      id_(std::move(id)),
      room_(std::move(room)),
      name_(id_.str()),
      lender_([this] {
        drain_ends_ = parts_.loop.deadline_in(kDrainTimeout);
        drain_timer_.enable_in(Duration::zero());
      }),
      wait_timer_(EventSource::timer(parts.loop, [this] { on_wait_timer(); })),
      drain_timer_(EventSource::timer(parts.loop, [this] { on_drain_timer(); })),
      turn_timer_(EventSource::timer(parts.loop, [this] { publish(); })),
      channel_(parts, name_, *this) {}

// --- the connection

void RemoteWriter::on_up(FrameConnection&, const wire::Greeting& them) {
  may_tear_ = them.has_feature(wire::kFeatureTorn);
  ask();
}

// Asks for the stream as the first of those who wait wants it, or as it was before.
void RemoteWriter::ask() {
  step_ = Step::opening;
  net::Frame frame;
  frame.set_serial(kOpenSerial);
  std::optional<CreatePlan> plan;
  if (!waiting_.empty()) {
    plan = waiting_.front().plan;
  } else if (creates_ && !removed_) {
    plan = CreatePlan{ring_->stream()->type(), history_};
  }
  if (plan) {
    proto::Create& create = *frame.mutable_create();
    wire::to_message(id_, *create.mutable_id());
    wire::to_message(plan->type, *create.mutable_type());
    create.set_depth(plan->history.depth);
    create.set_cycle_ns(to_ns(plan->history.cycle));
  } else {
    wire::to_message(id_, *frame.mutable_open()->mutable_id());
  }
  channel_.link()->send(frame);
}

void RemoteWriter::on_down(const Error& why) {
  on_reopen();
  trouble_ = why;
  if (ring_ && !removed_) log_error(why);
}

void RemoteWriter::on_reopen() {
  stop_publishing();
  step_ = Step::none;
}

void RemoteWriter::on_stream_there() {
  if (removed_) channel_.try_again();
}

Result<void> RemoteWriter::on_frame(net::Frame& frame) {
  switch (frame.body_case()) {
    case net::Frame::kOpened:
      return on_opened_untrusted(frame.opened());
    case net::Frame::kPublishing:
      return on_publishing_untrusted(frame.publishing());
    case net::Frame::kPublished:
      return on_published_untrusted(frame.published());
    case net::Frame::kEnded:
      removed_ = true;
      on_refused({Errc::not_found, "stream '" + name_ + "' was removed on its host"});
      return {};
    case net::Frame::kFailure:
      on_refused(wire::failure(frame.failure()));
      return {};
    default:
      return {};  // of a later version
  }
}

Result<void> RemoteWriter::on_opened_untrusted(const proto::Opened& opened) {
  if (step_ != Step::opening) return unexpected_frame("Opened");
  const Result<StreamInfo> theirs = owner_stream_untrusted(opened, id_);
  if (!theirs) return theirs.error();
  if (Result<void> followed = follow(*theirs); !followed) {
    step_ = Step::none;  // that is not what one of those who wait asked for, but true for all
    on_refused(followed.error());
    return {};
  }
  removed_ = false;
  answer_waiting(opened.created());
  step_ = Step::starting;
  net::Frame start;
  start.set_serial(kStartSerial);
  start.mutable_start_publishing()->set_publisher(ring_->publisher());
  channel_.link()->send(start);
  return {};
}

// Makes sure that there is a ring for the owner's.
Result<void> RemoteWriter::follow(const StreamInfo& theirs) {
  history_ = {theirs.depth, theirs.cycle};
  if (ring_) {
    if (Result<void> usable = theirs.type.check_usable_as(ring_->stream()->type()); !usable) {
      return std::move(usable).error().context("stream '" + name_ + "' has another type by now");
    }
    return {};
  }
  Result<std::unique_ptr<OutgoingRing>> ring = OutgoingRing::make(theirs, parts_.registry.budget());
  if (!ring) return std::move(ring).error().context("write to '" + name_ + "'");
  return take_ring(*std::move(ring));
}

Result<void> RemoteWriter::take_ring(std::unique_ptr<OutgoingRing> ring) {
  Result<std::shared_ptr<StreamFeed>> feed = StreamFeed::open(parts_.loop, ring->stream());
  if (!feed) return std::move(feed).error().context("write to '" + name_ + "'");
  feed_ = *std::move(feed);
  ring_ = std::move(ring);
  return {};
}

// The stream is not to be had, or not as it was.
void RemoteWriter::on_refused(const Error& why) {
  const bool opening = step_ == Step::opening;
  on_reopen();
  if (opening && !waiting_.empty()) {
    // What one program wants may be refused, and what the next one wants not.
    const Waiting first = std::move(waiting_.front());
    waiting_.erase(waiting_.begin());
    first.then(why);
    if (!waiting_.empty()) return ask();
    if (!ring_) return end();
  } else {
    fail_waiting(why);
  }
  trouble_ = why;
  if (why.code == Errc::not_found && !creates_) removed_ = true;
  if (ring_) log_error(why);
  channel_.try_again_later();
}

// --- publishing

Result<void> RemoteWriter::on_publishing_untrusted(const net::Publishing& publishing) {
  if (step_ != Step::starting) return unexpected_frame("Publishing");
  if (Result<void> noted = note_published_untrusted(publishing.last()); !noted) return noted;
  start_publishing();
  return {};
}

void RemoteWriter::start_publishing() {
  step_ = Step::publishing;
  trouble_.reset();
  if (std::exchange(told_, false)) {
    parts_.logger.notice("stream '" + name_ + "' takes our samples again, from sample " +
                             std::to_string(ring_->next_untrusted()) + " on",
                         log_fields());
  }
  FrameConnection& link = *channel_.link();
  sender_.emplace(ring_->mapping(), link,
                  SampleSender::Options{may_tear_, &parts_.registry.budget()});
  SamplePump::Observer& events = *this;
  pump_.emplace(ring_->mapping(), link, *sender_, events,
                SamplePump::Plan{.first = ring_->next_untrusted()});
  // From the loop: this may be the middle of what the link hands out.
  turn_timer_.enable_in(Duration::zero());
}

void RemoteWriter::publish() {
  if (!pump_) return;
  const Result<PumpWait> wait = pump_->pump({});
  if (!wait) return channel_.link()->close_with(wait.error());
  if (*wait == PumpWait::turn || (*wait == PumpWait::news && !feed_->wait(*this, pump_->known()))) {
    turn_timer_.enable_in(Duration::zero());
  }
}

void RemoteWriter::stop_publishing() noexcept {
  turn_timer_.disable();
  if (feed_) feed_->forget(*this);
  pump_.reset();
  sender_.reset();
}

Result<void> RemoteWriter::on_published_untrusted(const net::Published& published) {
  if (step_ != Step::publishing) return unexpected_frame("Published");
  return note_published_untrusted(published.last());
}

Result<void> RemoteWriter::note_published_untrusted(Tid last) {
  if (Result<void> noted = ring_->note_published_untrusted(last); !noted) return noted;
  if (!lender_.any_lent()) drain_timer_.enable_in(Duration::zero());
  return {};
}

void RemoteWriter::on_gap(Tid, std::uint64_t count) {
  lost_samples_ += count;
  const auto unlogged = loss_lines_.admit(parts_.loop.now(), count);
  if (!unlogged) return;
  parts_.logger.warning(
      "stream '" + name_ + "' lacks " + std::to_string(*unlogged) + " samples written here, " +
          std::to_string(lost_samples_) +
          " in all: the local ring no longer held them when their turn came; keep more history, "
          "or write less than the link carries",
      log_fields());
}

// --- programs

OpenedRing RemoteWriter::lend(bool created) {
  done_ = false;
  return {lender_.lend(ring_->stream()), created};
}

void RemoteWriter::open(const CreatePlan* plan, Then then) {
  done_ = false;
  if (ring_ && !removed_) {
    if (Result<void> usable = check_plan(plan); !usable) return then(std::move(usable).error());
    return then(lend(false));
  }
  waiting_.push_back({std::move(then), plan ? std::optional(*plan) : std::nullopt,
                      parts_.loop.deadline_in(kOwnerTimeout)});
  arm_wait_timer();
  if (ring_) channel_.try_again();
}

Result<void> RemoteWriter::check_plan(const CreatePlan* plan) {
  if (!plan) return {};
  if (Result<void> usable = ring_->stream()->type().check_usable_as(plan->type); !usable) {
    return std::move(usable).error().context("stream '" + name_ + "'");
  }
  creates_ = true;
  return {};
}

Result<std::shared_ptr<Stream>> RemoteWriter::adopt_untrusted(OfferedFiles&& files) {
  if (ring_) {
    if (!ring_->stream()->is_ring(files.ring.get())) {
      return Error{Errc::conflict, "another ring is published into stream '" + name_ +
                                       "' by now; close this one and open the stream anew"};
    }
    ring_->stream()->take_doorbell_untrusted(std::move(files.doorbell));
    return lend(false).stream;
  }
  Result<std::shared_ptr<Stream>> stream =
      Stream::adopt_untrusted(std::move(files), parts_.registry.budget());
  if (!stream) return std::move(stream).error().context("write to '" + name_ + "'");
  if ((*stream)->id() != id_ || (*stream)->purpose() != Purpose::remote_writer) {
    return Error{Errc::protocol, "write to '" + name_ + "': the offered ring is that of '" +
                                     (*stream)->id().str() + "', or no remote writer's"};
  }
  Result<std::unique_ptr<OutgoingRing>> ring = OutgoingRing::open(*std::move(stream));
  if (!ring) return std::move(ring).error().context("write to '" + name_ + "'");
  const ring::RingMapping& mapping = (*ring)->mapping();
  history_ = {mapping.geometry().depth, mapping.identity().cycle};
  if (Result<void> taken = take_ring(*std::move(ring)); !taken) return std::move(taken).error();
  creates_ = true;  // at worst a program that only opened it gets it back as well
  return lend(false).stream;
}

void RemoteWriter::answer_waiting(bool created) {
  wait_timer_.disable();
  for (const Waiting& one : std::exchange(waiting_, {})) {
    if (Result<void> usable = check_plan(one.plan ? &*one.plan : nullptr); !usable) {
      one.then(std::move(usable).error());
    } else {
      one.then(lend(std::exchange(created, false)));
    }
  }
  if (!lender_.any_lent()) drain_timer_.enable_in(Duration::zero());
}

void RemoteWriter::fail_waiting(const Error& why) {
  wait_timer_.disable();
  for (const Waiting& one : std::exchange(waiting_, {})) one.then(why);
  if (!ring_ && waiting_.empty()) end();
}

void RemoteWriter::arm_wait_timer() {
  if (waiting_.empty()) return wait_timer_.disable();
  wait_timer_.enable_in(std::max(waiting_.front().deadline - parts_.loop.now(), Duration::zero()));
}

void RemoteWriter::on_wait_timer() {
  const MonoTime now = parts_.loop.now();
  const auto later = std::find_if(waiting_.begin(), waiting_.end(),
                                  [now](const Waiting& one) { return one.deadline > now; });
  const std::vector<Waiting> overdue(waiting_.begin(), later);
  waiting_.erase(waiting_.begin(), later);
  const Error why{Errc::unavailable, "write to '" + name_ + "': host '" + id_.host +
                                         "' does not answer at '" + channel_.address().str() + "'" +
                                         (trouble_ ? ": " + trouble_->message : "") +
                                         "; look at `dssmctl hosts`, and try again"};
  for (const Waiting& one : overdue) one.then(why);
  if (!ring_ && waiting_.empty()) return end();
  arm_wait_timer();
}

// All programs have closed it.
void RemoteWriter::on_drain_timer() {
  if (lender_.any_lent() || !waiting_.empty()) return;
  const MonoTime now = parts_.loop.now();
  if (ring_->all_published()) return end();
  if (now < drain_ends_) {
    feed_->look();  // a writer that was killed may not have rung
    return drain_timer_.enable_in(drain_ends_ - now);
  }
  parts_.logger.warning(
      "give up samples " + std::to_string(ring_->next_untrusted()) + " to " +
          std::to_string(ring_->newest_untrusted()) + " of stream '" + name_ +
          "', which could not be published within 10 s after their writer had gone" +
          (trouble_ ? ": " + trouble_->message : ""),
      log_fields());
  end();
}

void RemoteWriter::end() {
  done_ = true;
  keeper_.on_remote_writer_done();
}

// --- the log

LogFields RemoteWriter::log_fields() const {
  return {.stream = name_, .peer = id_.host, .message_id = message_id::kRemoteWriter};
}

// Once, not at each attempt.
void RemoteWriter::log_error(const Error& why) {
  if (std::exchange(told_, true)) return;
  parts_.logger.notice(
      "samples for stream '" + name_ + "' stay here: " + why.message + "; trying again",
      log_fields());
}

}  // namespace dssm::daemon
