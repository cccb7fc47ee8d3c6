// SPDX-License-Identifier: Apache-2.0
//
// On each connection: Open or Create; StartPublishing, whose answer holds the last sample that the
// owner has; then samples, as programs write them, until the connection ends.
#include "daemon/remote/remote_writer.hpp"

#include <fmt/format.h>

#include <new>
#include <utility>

#include "core/base/try.hpp"
#include "core/wire/messages.hpp"
#include "daemon/base/message_ids.hpp"

namespace dssm::daemon {

RemoteWriter::RemoteWriter(const ChannelParts& parts, StreamId id, RingQuota quota,
                           std::function<void()> on_done)
    : RemoteStream(parts,
                   {Purpose::remote_writer, message_id::kRemoteWriter,
                    "the local ring no longer held what programs here wrote when its turn came; "
                    "keep more history, or write less than the network carries",
                    "samples for stream '{}' stay here"},
                   std::move(id), std::move(quota), std::move(on_done)),
      drain_timer_(EventSource::timer(parts.loop, [this] { on_drain_timer(); })),
      turn_timer_(EventSource::timer(parts.loop, [this] { publish(); })) {}

// --- protocol steps

void RemoteWriter::on_connected(const wire::Greeting& them) {
  may_tear_ = them.has_feature(wire::kFeatureTorn);
  open_at_owner();
}

// Asks for the stream as the first program that waits wants it, or as it was before.
void RemoteWriter::open_at_owner() {
  // Those that may not create it must not keep the right of one that closed it. Without any, it is
  // created as before for as long as samples are left to publish.
  if (creates_ && parts_.opens && ring_ && !is_unused()) {
    creates_ = parts_.opens->any_creates(*ring_->stream());
  }
  std::optional<CreatePlan> plan;
  if (const std::optional<CreatePlan>* wanted = first_pending()) {
    plan = *wanted;
  } else if (creates_ && !is_removed_) {
    plan = CreatePlan{ring_->stream()->type(), history_, true};
  }
  channel_.open(id_, plan ? &*plan : nullptr);
}

Result<void> RemoteWriter::on_opened(StreamInfo theirs, bool created) {
  if (Result<void> followed = follow(theirs); !followed) {
    fail_pending(followed.error());  // its samples could not be published
    stop(followed.error(), is_removed_);
    return {};
  }
  is_removed_ = false;
  answer_pending(created);
  channel_.publish(ring_->publisher());
  begin_users();
  return {};
}

Result<void> RemoteWriter::on_published_untrusted(std::int64_t last, Tid, bool begins) {
  DSSM_TRY(ring_->set_published_untrusted(last));
  if (is_unused()) drain_timer_.enable_in(Duration::zero());
  if (begins) start_publishing();
  return {};
}

// The owner may refuse what one program wants, and not what the next one wants.
Result<void> RemoteWriter::on_refused(channel::ChannelClient::Request request, const Error& why) {
  if (request == channel::ChannelClient::Request::open && first_pending()) {
    fail_first_pending(why);
    if (done()) return {};
    if (first_pending()) return open_at_owner(), Result<void>();
  }
  stop(why, is_removed_ || (why.code == Errc::not_found && !creates_));
  return {};
}

// --- the ring

std::shared_ptr<Stream> RemoteWriter::stream() const noexcept {
  return ring_ ? ring_->stream() : nullptr;
}

// Makes sure that there is a ring for the owner's.
Result<void> RemoteWriter::follow(const StreamInfo& theirs) {
  history_ = {theirs.depth, theirs.cycle};
  if (ring_) {
    DSSM_TRY(theirs.type.check_usable_as(ring_->stream()->type()),
             "stream '" + name_ + "' has another type now");
    return {};
  }
  const std::string context = "write to '" + name_ + "'";
  auto ring = DSSM_TRY(OutgoingRing::make(theirs, parts_.registry.budgets(), account()), context);
  DSSM_TRY(use_ring(std::move(ring)), context);
  return {};
}

Result<void> RemoteWriter::use_offered(std::shared_ptr<Stream> stream) {
  std::unique_ptr<OutgoingRing> ring = DSSM_TRY(OutgoingRing::open(std::move(stream)));
  const ring::RingMapping& mapping = ring->mapping();
  history_ = {mapping.geometry().depth, mapping.identity().cycle};
  return use_ring(std::move(ring));
}

Result<void> RemoteWriter::use_ring(std::unique_ptr<OutgoingRing> ring) {
  feed_ = DSSM_TRY(StreamFeed::open(parts_.loop, ring->stream()));
  ring_ = std::move(ring);
  return {};
}

void RemoteWriter::start_publishing() {
  if (clear_error()) {
    parts_.logger.notice(fmt::format("stream '{}' takes our samples again, from sample {} on",
                                     name_, ring_->next_untrusted()),
                         log_fields());
  }
  FrameConnection& connection = *connection_.frames();
  sender_.emplace(
      ring_->mapping(), connection,
      SampleSender::Options{may_tear_, &parts_.registry.budgets().of(ring_->stream()->account())});
  connection.set_priority(
      parts_.sending.demand_for(id_, ring_->mapping().geometry().payload_bytes).priority);
  SamplePump::Observer& observer = *this;
  pump_.emplace(ring_->mapping(), connection, *sender_, observer,
                SamplePump::Plan{.first = ring_->next_untrusted()});
  // From the loop: the connection may be handing out frames at this moment.
  turn_timer_.enable_in(Duration::zero());
}

// Also called by a feed, which must get no exception.
void RemoteWriter::publish() {
  if (!pump_) return;
  try {
    pump();
  } catch (const std::bad_alloc&) {
    connection_.frames()->close_with(no_memory_left());
  }
}

void RemoteWriter::pump() {
  const Result<PumpWait> wait = pump_->pump({});
  if (!wait) return connection_.frames()->close_with(wait.error());
  if (*wait == PumpWait::turn ||
      (*wait == PumpWait::sample && !feed_->wait(*this, pump_->known()))) {
    turn_timer_.enable_in(Duration::zero());
  }
}

void RemoteWriter::stop_publishing() noexcept {
  turn_timer_.disable();
  if (feed_) feed_->forget(*this);
  pump_.reset();
  sender_.reset();
}

// --- programs

Result<void> RemoteWriter::check_open(const CreatePlan* plan) {
  if (!plan) return {};
  const std::string context = "stream '" + name_ + "'";
  DSSM_TRY(ring_->stream()->type().check_usable_as(plan->type), context);
  if (!plan->keep_existing && plan->history.depth > history_.depth) {
    return Error{Errc::conflict,
                 fmt::format("{}: its ring has {} slots, and this program asks for {}; {}ask for "
                             "less",
                             context, history_.depth, plan->history.depth,
                             plan->scope == CreatePlan::Scope::replace
                                 ? "another program of this PC writes it: end that one, or "
                                 : "dssmd's key 'rights' does not allow it to replace the ring: ")};
  }
  if (plan->scope != CreatePlan::Scope::join) creates_ = true;
  return {};
}

// No program uses the ring. The programs' last samples are published before it ends.
void RemoteWriter::on_drain_timer() {
  if (!is_unused() || !ring_) return;
  if (ring_->all_published()) return finish();
  const Duration left = unused_since() + kDrainTimeout - parts_.loop.now();
  if (left > Duration::zero()) {
    feed_->poll();  // a writer that was killed may not have rung
    return drain_timer_.enable_in(left);
  }
  parts_.logger.warning(
      fmt::format("give up samples {} to {} of stream '{}', which could not be published within "
                  "10 s after their writer closed it{}",
                  ring_->next_untrusted(), ring_->newest_untrusted(), name_,
                  last_error_ ? ": " + last_error_->message : ""),
      log_fields());
  finish();
}

}  // namespace dssm::daemon
