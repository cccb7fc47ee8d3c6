// SPDX-License-Identifier: Apache-2.0
//
// On each connection: Open, and from its answer the ring; Subscribe from what comes next in that
// ring; then samples and gaps until the connection ends.
#include "daemon/remote/mirror.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <utility>

#include "core/base/try.hpp"
#include "core/wire/messages.hpp"
#include "daemon/base/message_ids.hpp"

namespace dssm::daemon {

using channel::ChannelClient;

Mirror::Mirror(const ChannelParts& parts, StreamId id, RingQuota quota,
               std::function<void()> on_done)
    : RemoteStream(parts,
                   {Purpose::mirror, message_id::kMirror,
                    "the network did not carry them in time; keep more history on its host, or "
                    "write less than the network carries",
                    "mirror '{}' keeps what it has"},
                   std::move(id), std::move(quota), std::move(on_done)),
      clock_(parts.clock, id_),
      fill_timer_(EventSource::timer(parts.loop, [this] { notify_replaced(); })),
      linger_timer_(EventSource::timer(parts.loop, [this] {
        if (is_unused()) finish();
      })) {}

// --- protocol steps

void Mirror::on_connected(const wire::Greeting& them) {
  on_owner_clock(them.clock);
  newest_first_ = them.has_feature(wire::kFeatureNewestFirst);
  channel_.open(id_, nullptr);
}

Result<void> Mirror::on_opened(StreamInfo theirs, bool) {
  if (Result<void> followed = follow_untrusted(theirs); !followed) {
    stop(followed.error(), false);
    return {};
  }
  is_removed_ = is_subscribed_ = is_fresh_ = false;
  connection_.frames()->take_samples(theirs.type.payload_bytes, *this);
  ++subscriptions_;
  subscribe();
  begin_users();
  set_pending_deadline(parts_.loop.deadline_in(kFillTimeout));
  if (!replaced_.empty()) fill_timer_.enable_in(kFillTimeout);
  return {};
}

void Mirror::subscribe() {
  // Which samples have a place in a ring that is shorter, only the owner's newest one tells.
  const bool is_known = !is_shorter_ || is_subscribed_;
  with_history_ = (wants_history() && is_known) || !newest_first_;
  net::Subscribe request;
  ring_->resume(newest_first_, with_history_, request);
  // Here the oldest samples that are missing have no place: the newest of them first.
  if (is_shorter_ && request.has_backlog_from()) request.set_backlog_from(channel::kMaxTid);
  max_rate_hz_ = wanted_rate_hz();
  request.set_max_rate_hz(max_rate_hz_);
  channel_.subscribe(request);
}

Result<void> Mirror::on_subscribed_untrusted(Tid first, bool newest_first, Tid oldest, Tid newest) {
  DSSM_TRY(ring_->on_subscribed_untrusted(first, newest_first, oldest));
  is_subscribed_ = true;
  fresh_from_ = newest;
  log_new_gap();
  last_error_.reset();
  if ((!with_history_ && wants_history()) || max_rate_hz_ != wanted_rate_hz()) subscribe();
  return {};
}

double Mirror::wanted_rate_hz() const noexcept {
  return newest_first_ ? parts_.mirrors.demand_for(id_).max_rate_hz : 0;
}

bool Mirror::wants_history() const noexcept {
  return history_wanted_ || history_use_.in_use() || parts_.mirrors.demand_for(id_).history_at_once;
}

void Mirror::want_history() {
  const bool is_live = channel_.reading() == ChannelClient::Reading::live && !is_ending_;
  if (is_live && with_history_ && ring_->filling_samples() == 0) return;  // it is here
  history_wanted_ = true;
  subscribe_for_history();
}

std::shared_ptr<Stream> Mirror::with_history(const std::shared_ptr<Stream>& ring) {
  std::shared_ptr<Stream> held = history_use_.acquire(ring);
  subscribe_for_history();
  return held;
}

void Mirror::subscribe_for_history() {
  if (!with_history_ && channel_.reading() >= ChannelClient::Reading::filling) subscribe();
}

std::string_view Mirror::gap_reason() const noexcept {
  return is_shorter_
             ? "the network did not carry them in time, or more were written meanwhile than "
               "this PC keeps; keep more history here (key mirror_streams)"
             : "";
}

std::uint64_t Mirror::depth_for(const StreamInfo& theirs) const noexcept {
  const Duration history = parts_.mirrors.demand_for(id_).max_history;
  if (history == Duration() || theirs.cycle <= Duration()) return theirs.depth;
  const auto slots = static_cast<std::uint64_t>((history - Duration(1)) / theirs.cycle) + 2;
  return std::clamp(slots, kMinDepth, std::max(theirs.depth, kMinDepth));
}

void Mirror::on_new_demand() {
  if (parts_.mirrors.demand_for(id_).history_at_once) want_history();
  const bool is_answered = channel_.reading() >= ChannelClient::Reading::filling;
  if (is_answered && max_rate_hz_ != wanted_rate_hz()) subscribe();
}

Result<void> Mirror::on_caught_up() {
  if (with_history_) history_wanted_ = false;
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
  if (!is_ending_) answer_pending(false);
  return {};
}

Result<void> Mirror::on_gap_untrusted(Tid first, std::uint64_t count) {
  DSSM_TRY(ring_->on_gap_untrusted(first, count));
  ring_->wake();  // readers that wait for these
  log_new_gap();
  return {};
}

// The ring stays for its readers. A removed stream that is created again is found by the catalog,
// or by asking the owner.
Result<void> Mirror::on_refused(ChannelClient::Request request, const Error& why) {
  // The subscription before goes on: the stream is being removed, and its last samples come.
  if (request == ChannelClient::Request::subscribe && channel_.takes_samples()) return {};
  const bool is_forbidden = why.code == Errc::no_permission;
  const bool is_removed = is_forbidden || why.code == Errc::not_found;
  const bool was_removed = is_removed_;
  if (ring_ && is_removed) ring_->end_filling();
  stop(why, is_removed);
  // This host has lost the right to read it: its readers ask again, and get that answer.
  if (is_forbidden && ring_ && !was_removed && parts_.on_ring_replaced) {
    parts_.on_ring_replaced(*ring_->stream());
  }
  return {};
}

Result<void> Mirror::on_other_frame(net::Frame& frame) {
  if (!frame.has_pong()) return RemoteStream::on_other_frame(frame);
  const net::Pong& pong = frame.pong();
  std::optional<MirrorClock::OnChannel> on_channel;
  if (pong.has_newest_tid()) {
    on_channel = {std::clamp<Tid>(pong.newest_tid(), kNoTid, channel::kMaxTid),
                  pong.has_other_clocks()};
  }
  on_owner_clock(wire::clock_report_untrusted(pong), on_channel);
  return {};
}

void Mirror::on_channel_end() {
  is_ending_ = false;
  if (ring_) ring_->wake();  // for the last samples
}

// --- what the catalog knows

void Mirror::on_stream_added(const StreamInfo& theirs) {
  is_ending_ = false;
  describe_as_untrusted(theirs);
  RemoteStream::on_stream_added(theirs);
}

// The channel may be earlier than the catalog, and the mirror live with the next ring.
void Mirror::on_stream_removed(std::uint64_t incarnation) {
  is_ending_ = channel_.takes_samples() && ring_->stream()->incarnation() == incarnation;
}

void Mirror::on_owner_clock(MirrorClock::Report report,
                            const std::optional<MirrorClock::OnChannel>& on_channel) {
  clock_.on_owner(std::move(report), ring_ ? ring_->newest() : kNoTid, MonoClock::now(),
                  on_channel);
  assess_clock();
}

void Mirror::assess_clock() {
  if (!ring_ || !clock_.has_report()) return;
  clock_.on_time(ring_->newest(), MonoClock::now());
  ring_->set_clock(clock_.assessment());
}

// --- samples

[[gnu::hot]] Result<void> Mirror::on_sample_begin(const wire::IncomingSample& sample,
                                                  std::byte*& out) {
  if (!channel_.takes_samples()) return ChannelClient::unexpected("a sample");
  // This clock may have been set or slewed: readers have to know before they get the samples.
  if (!std::exchange(in_batch_, true) && parts_.clock) parts_.clock->clock_generation();
  const Result<std::byte*> place = ring_->begin_untrusted(sample);
  if (!place) return place.error();
  out = *place;
  return {};
}

[[gnu::hot]] Result<void> Mirror::on_sample_end(const wire::IncomingSample& sample, bool torn) {
  ring_->end(sample, torn);
  log_new_gap();
  if (!torn && !is_fresh_ && sample.info.tid >= fresh_from_) {
    is_fresh_ = true;
    answer_ready();
  }
  return {};
}

[[gnu::hot]] void Mirror::on_batch_end() {
  in_batch_ = false;
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
        ours.mapping().geometry().depth <= theirs.depth) {
      is_shorter_ = ours.mapping().geometry().depth < theirs.depth;
      describe_as_untrusted(theirs);
      return {};
    }
    return Error{
        Errc::protocol,
        fmt::format("the owner of '{}' describes the same ring with another size than before",
                    name_)};
  }
  const std::string context = "mirror '" + name_ + "'";
  const std::uint64_t depth = depth_for(theirs);
  is_shorter_ = depth < theirs.depth;
  Result<std::shared_ptr<Stream>> stream = Stream::create({.id = id_,
                                                           .type = theirs.type,
                                                           .depth = depth,
                                                           .cycle = theirs.cycle,
                                                           .account = account(),
                                                           .purpose = Purpose::mirror,
                                                           .incarnation = theirs.incarnation},
                                                          parts_.registry.budgets());
  if (!stream && stream.error().code == Errc::limit_exceeded) {
    return Error{Errc::limit_exceeded,
                 stream.error().message +
                     "; or keep less of another host's stream here (key mirror_streams)"}
        .context(context);
  }
  if (!stream) return std::move(stream).error().context(context);
  return DSSM_TRY(use_offered(*std::move(stream)), context), Result<void>();
}

// The owner's stream may be described while this host mirrors it. Lists leave out the fields of
// many types.
void Mirror::describe_as_untrusted(const StreamInfo& theirs) {
  if (!ring_ || ring_->stream()->incarnation() != theirs.incarnation) return;
  Stream& ours = *ring_->stream();
  if (theirs.type.fields.empty() || theirs.type == ours.type() ||
      theirs.type.payload_bytes != ours.type().payload_bytes) {
    return;
  }
  const Result<void> described =
      ours.describe_as(theirs.type, parts_.registry.budgets().of(ours.account()));
  if (!described) parts_.logger.warning(described.error().message);
}

Result<void> Mirror::use_offered(std::shared_ptr<Stream> stream) {
  MemoryBudget& budget = parts_.registry.budgets().of(stream->account());
  replace_ring(DSSM_TRY(MirrorRing::open(std::move(stream), budget)));
  return {};
}

void Mirror::replace_ring(std::unique_ptr<MirrorRing> ring) {
  if (ring_) {
    ++restarts_;
    ring_->end_filling();
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
  logged_gap_ = 0;
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

bool Mirror::can_open_now(bool waits_for_history) const noexcept {
  const bool has_newest = newest_first_ && is_fresh_;
  return ring_ && !is_removed_ && !is_ending_ &&
         (!is_filling() || (has_newest && !waits_for_history));
}

Duration Mirror::open_timeout() const noexcept {
  return is_filling() ? kFillTimeout : kOwnerTimeout;
}

void Mirror::on_unused() { linger_timer_.enable_in(parts_.mirror_linger); }

bool Mirror::is_filling() const noexcept {
  return channel_.reading() == ChannelClient::Reading::asked ||
         channel_.reading() == ChannelClient::Reading::filling;
}

proto::Mirror::State Mirror::shown_state() const noexcept {
  const bool is_forbidden = last_error_ && last_error_->code == Errc::no_permission;
  if (is_removed_ && !is_forbidden) return proto::Mirror::REMOVED;
  if (is_filling()) return proto::Mirror::FILLING;
  if (channel_.takes_samples()) return proto::Mirror::LIVE;
  return ring_ && last_error_ ? proto::Mirror::OWNER_UNAVAILABLE : proto::Mirror::CONNECTING;
}

void Mirror::describe(proto::Mirror& out) const {
  out.set_state(shown_state());
  out.set_gap_samples(earlier_.gap_samples + (ring_ ? ring_->gap_samples() : 0));
  out.set_reconnects(subscriptions_ > 0 ? subscriptions_ - 1 : 0);
  out.set_restarts(restarts_);
  out.set_newest(ring_ ? ring_->newest() : kNoTid);
  out.set_received_samples(earlier_.received_samples + (ring_ ? ring_->received_samples() : 0));
  out.set_received_bytes(earlier_.received_bytes + (ring_ ? ring_->received_bytes() : 0));
  if (last_error_) out.set_error(last_error_->message);
  out.set_clock(clock_.reason());
  out.set_clock_refused(!out.clock().empty() && clock_.refuses());
  if (!ring_) return;
  out.set_depth(ring_->stream()->mapping().geometry().depth);
  out.set_newest_time_ns(to_ns(ring_->newest_time()));
  out.set_filling_samples(ring_->filling_samples());
  out.set_history_wanted(with_history_ || wants_history());
  const MirrorRing::Recent recent = ring_->recent();
  out.set_recent_samples(recent.samples);
  out.set_recent_lost_samples(recent.lost);
  out.set_max_rate_hz(max_rate_hz_);
}

bool Mirror::describe_stream(proto::Stream& out) const {
  if (!ring_) return false;
  wire::to_message(ring_->stream()->info(), out);
  describe(*out.mutable_mirror());
  return true;
}

}  // namespace dssm::daemon
