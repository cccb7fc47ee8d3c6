// SPDX-License-Identifier: Apache-2.0
#include "daemon/serve/stream_channel.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <utility>

#include "core/base/try.hpp"
#include "core/wire/messages.hpp"

namespace dssm::daemon {
namespace {

// A reader that was lapped this often while it was answered is not keeping up.
constexpr int kMaxReadAttempts = 100;

// New samples that are followed at once before others get their turn.
constexpr int kMaxChecks = 16;

net::Frame answer_to(std::uint64_t serial) {
  net::Frame frame;
  frame.set_serial(serial);
  return frame;
}

}  // namespace

StreamChannel::StreamChannel(const Parts& parts, std::shared_ptr<ServedStream> served,
                             bool may_tear)
    : parts_(parts),
      served_(std::move(served)),
      sends_clock_(parts.clock && parts.them.has_feature(wire::kFeatureClock)),
      reader_(stream().mapping()),
      sender_(stream().mapping(), parts_.link, {may_tear, &parts_.budget}),
      due_(EventSource::timer(parts_.loop, [this] { parts_.observer.work_now(); })) {
  served_->stream().set_channel(
      {.key = this,
       .states_users = !parts_.them.is_dssmd() || parts_.them.has_feature(wire::kFeatureUsers)});
  set_program(false, false);
  parts_.link.take_samples(stream().type().payload_bytes, *this);
}

StreamChannel::~StreamChannel() {
  if (feed_) feed_->forget(*this);
  served_->stream().remove_channel(this);
}

Result<void> StreamChannel::serve_untrusted(const net::Frame& request) {
  if (stream().removed()) {
    return Error{Errc::not_found,
                 "stream '" + stream().id().str() + "' was removed; create it again"};
  }
  switch (request.body_case()) {
    case net::Frame::kSubscribe:
      set_program(true, writes_);
      return subscribe(request.serial(), request.subscribe());
    case net::Frame::kRead:
      set_program(true, writes_);
      reading_ = {request.serial(), request.read(), 0};
      go_on_reading();
      return {};
    case net::Frame::kGetRange:
      set_program(true, writes_);
      return get_range(request.serial(), request.get_range());
    case net::Frame::kSetUsers:
      return set_users(request.serial(), request.set_users());
    case net::Frame::kStartPublishing:
      set_program(reads_, true);
      return start_publishing(request.serial(), request.start_publishing());
    case net::Frame::kSetProperty:
    case net::Frame::kGetProperty:
      return serve_property(request);
    case net::Frame::kOpen:
    case net::Frame::kCreate:
      return Error{Errc::protocol, "this channel carries '" + stream().id().str() +
                                       "' already; open another connection for another stream"};
    default:
      return Error{Errc::protocol,
                   "a channel takes no such request; it is for control connections, or of a newer "
                   "version than this dssmd (" DSSM_VERSION ")"};
  }
}

// --- who uses the stream over this channel

// A program that is connected itself, as it reads and writes. One that has done neither is about to
// read: a writer begins with StartPublishing.
void StreamChannel::set_program(bool reads, bool writes) {
  if (parts_.them.is_dssmd()) return;
  const bool is_known = reads == reads_ && writes == writes_;
  if (is_known && (reads || writes)) return;
  reads_ = reads;
  writes_ = writes;
  Stream::Channel channel{.key = this};
  StreamUser user{.pid = parts_.them.pid,
                  .program = parts_.them.program,
                  .role = Role::reader,
                  .via = StreamVia::connection,
                  .host = parts_.them.host};
  if (reads || !writes) {
    channel.users.push_back(user);
    channel.readers = 1;
  }
  if (writes) {
    user.role = Role::writer;
    channel.users.push_back(std::move(user));
    channel.writers = 1;
  }
  served_->stream().set_channel(std::move(channel));
}

// The programs of another host, as its dssmd states them.
Result<void> StreamChannel::set_users(std::uint64_t serial, const net::SetUsers& request) {
  if (!parts_.them.is_dssmd()) {
    return Error{Errc::protocol, "only a dssmd states which programs use a channel"};
  }
  if (static_cast<std::size_t>(request.users_size()) > wire::kMaxChannelUsers) {
    return Error{Errc::limit_exceeded,
                 fmt::format("{} programs are named as the users of one channel; at most {} may be",
                             request.users_size(), wire::kMaxChannelUsers)};
  }
  Stream::Channel channel{.key = this};
  for (const proto::User& message : request.users()) {
    StreamUser user = wire::stream_user_untrusted(message);
    const bool writes = user.role == Role::writer;
    user.via = writes ? StreamVia::remote_writer : StreamVia::mirror;
    user.uid = message.uid();
    user.host = parts_.them.host;
    ++(writes ? channel.writers : channel.readers);
    channel.users.push_back(std::move(user));
  }
  channel.writers = std::max(channel.writers, request.writers());
  channel.readers = std::max(channel.readers, request.readers());
  served_->stream().set_channel(std::move(channel));
  net::Frame frame = answer_to(serial);
  frame.mutable_done();
  parts_.link.send(frame);
  return {};
}

[[gnu::hot]] Result<void> StreamChannel::work(bool request_waits) {
  if (reading_) {
    go_on_reading();
    if (reading_) return {};
  }
  if (receiver_) receiver_->acknowledge();
  return go_on_pumping(request_waits);
}

// --- subscription

Result<void> StreamChannel::subscribe(std::uint64_t serial, const net::Subscribe& request) {
  if (!std::isfinite(request.max_rate_hz()) || request.max_rate_hz() < 0) {
    return Error{Errc::invalid_argument,
                 fmt::format("subscribe to '{}': max_rate_hz is {}; give 0 for all samples, or how "
                             "many per second at most",
                             stream().id().str(), request.max_rate_hz())};
  }
  if (!feed_) feed_ = DSSM_TRY(served_->feed());
  feed_->forget(*this);
  due_.disable();
  const SendingDemand demand =
      parts_.sending.demand_for(stream().id(), stream().type().payload_bytes);
  parts_.link.set_priority(demand.priority);
  parts_.link.set_history_share(demand.history_percent / 100.0);
  const Tid newest = newest_untrusted(reader_);
  const Tid first = first_tid(request);
  net::Frame frame = answer_to(serial);
  net::Subscribed& subscribed = *frame.mutable_subscribed();
  subscribed.set_incarnation(stream().incarnation());
  subscribed.set_first_tid(first);
  subscribed.set_newest(newest);
  subscribed.set_oldest(std::clamp<Tid>(reader_.oldest(), 0, newest + 1));
  SamplePump::Plan plan{first, newest, request.max_rate_hz()};
  if (request.newest_first()) {
    plan.newest_first = true;
    if (request.incarnation() == stream().incarnation()) {
      plan.held = {request.held_from(), request.held_to()};
      if (request.has_backlog_from()) plan.backlog_from = request.backlog_from();
    }
    subscribed.set_newest_first(true);
  }
  parts_.link.set_output_timeout(Duration::zero());
  parts_.link.send(frame);
  pump_.emplace(stream().mapping(), parts_.link, sender_, static_cast<SamplePump::Observer&>(*this),
                plan);
  // Also without samples: the client needs it for those that it has from an earlier connection.
  clock_generation_.reset();
  before_samples();
  parts_.observer.work_soon();
  return {};
}

Tid StreamChannel::first_tid(const net::Subscribe& request) const {
  const Tid next = newest_untrusted(reader_) + 1;
  // Of an empty ring that is 0, and no sample is passed over.
  const Tid oldest = next == 0 ? 0 : std::clamp<Tid>(reader_.oldest(), 0, next - 1);
  switch (request.start_case()) {
    case net::Subscribe::kFromTid: {
      const bool other_ring =
          request.incarnation() != 0 && request.incarnation() != stream().incarnation();
      return other_ring ? oldest : std::clamp<Tid>(request.from_tid(), 0, channel::kMaxTid);
    }
    case net::Subscribe::kFromTimeNs: {
      Tid tid = kNoTid;
      const Time time = time_from_ns(request.from_time_ns());
      return reader_.find(time, tid, kMaxFinds) == ReadStatus::ok
                 ? std::clamp<Tid>(tid, oldest, next)
                 : oldest;
    }
    case net::Subscribe::kFromOldest:
      return oldest;
    case net::Subscribe::kFromNewest:
      return std::max<Tid>(next - 1, 0);
    case net::Subscribe::kFromNow:
    case net::Subscribe::START_NOT_SET:
      break;
  }
  return next;
}

[[gnu::hot]] Result<void> StreamChannel::go_on_pumping(bool request_waits) {
  if (!pump_) return {};
  const MonoTime now = pump_->thins() ? parts_.loop.now() : parts_.loop.coarse_now();
  feed_->forget(*this);
  const std::uint64_t samples_before = sender_.counters().samples;
  const std::uint64_t bytes_before = sender_.payload_bytes();
  const auto has_sent_little = [&] {
    return sender_.payload_bytes() - bytes_before < SamplePump::kBytesPerTurn / 4 &&
           sender_.counters().samples - samples_before < SamplePump::kSamplesPerTurn / 4;
  };
  Result<PumpWait> wait = pump_->pump(now, request_waits);
  for (int checks = 0; wait && (*wait == PumpWait::sample || *wait == PumpWait::pace); ++checks) {
    if (feed_->wait(*this, pump_->known())) {
      if (*wait == PumpWait::pace) due_.enable_in(pump_->due() - parts_.loop.now());
      return {};
    }
    // One came between the check and the arming of the doorbell.
    wait = checks < kMaxChecks && has_sent_little() ? pump_->pump(now) : Result(PumpWait::turn);
  }
  if (!wait)
    return std::move(wait).error().context("send samples of '" + stream().id().str() + "'");
  switch (*wait) {
    case PumpWait::sample:
    case PumpWait::pace:
      break;
    case PumpWait::time:
      due_.enable_in(pump_->due() - now);
      break;
    case PumpWait::turn:
      parts_.observer.work_soon();
      break;
    case PumpWait::ended:
      pump_.reset();
      break;
    case PumpWait::output:
      break;
  }
  return {};
}

[[gnu::hot]] void StreamChannel::on_sample_available() { parts_.observer.work_now(); }

// The clock may have been set before these samples were written: the client has to know before it
// gets them.
[[gnu::hot]] void StreamChannel::before_samples() {
  if (!sends_clock_) return;
  const std::uint64_t generation = parts_.clock->clock_generation();
  const bool has_other_clocks = stream().mapping().header().clock.is_set();
  if (clock_generation_ == generation && has_other_clocks == sent_other_clocks_) return;
  clock_generation_ = generation;
  sent_other_clocks_ = has_other_clocks;
  sent_settled_from_ = parts_.self.clock ? parts_.self.clock->settled_from : Time();
  sender_.end_run();
  net::Frame frame;
  frame.mutable_pong()->set_newest_tid(newest_untrusted(reader_));
  frame.mutable_pong()->set_has_other_clocks(has_other_clocks);
  wire::send_clock(parts_.self, *frame.mutable_pong()->mutable_clock());
  parts_.link.send(frame);
}

// What is written from now on is of the present setting: so the client has to hear of it now, and
// not with the next sample, which would be the first one after that.
void StreamChannel::on_new_clock() {
  if (!sends_clock_ || !pump_ || !parts_.self.clock || sender_.busy()) return;
  if (parts_.self.clock->settled_from == sent_settled_from_) return;
  if (parts_.link.output_empty()) before_samples();
}

void StreamChannel::on_gap(Tid first, std::uint64_t count) {
  lost_ += count;
  net::Frame frame;
  frame.mutable_gap()->set_first_tid(first);
  frame.mutable_gap()->set_count(count);
  parts_.link.send(frame);
}

void StreamChannel::on_caught_up() {
  net::Frame frame;
  frame.mutable_caught_up();
  parts_.link.send(frame);
}

void StreamChannel::on_removed() {
  if (!pump_) return end();
  pump_->end_at(newest_untrusted(reader_));
  parts_.observer.work_soon();
}

void StreamChannel::on_end() { end(); }

void StreamChannel::end() {
  net::Frame frame;
  frame.mutable_ended()->set_removed(true);
  parts_.link.send(frame);
}

// --- reads

ReadStatus StreamChannel::find(const net::Read& request, Tid& tid) const {
  const Tid newest = newest_untrusted(reader_);
  switch (request.which_case()) {
    case net::Read::kTid:
      tid = request.tid();
      if (tid > newest) return ReadStatus::not_yet;
      return tid < 0 || tid < reader_.oldest() ? ReadStatus::too_old : ReadStatus::ok;
    case net::Read::kTimeNs: {
      const ReadStatus found = reader_.find(time_from_ns(request.time_ns()), tid, kMaxFinds);
      // An owner's ring has no hole, unless a program wrote one into it.
      return found == ReadStatus::arriving ? ReadStatus::too_old : found;
    }
    case net::Read::kNewerThan:
      tid = newest;
      return newest < 0 || newest <= request.newer_than() ? ReadStatus::not_yet : ReadStatus::ok;
    case net::Read::kNewest:
    case net::Read::WHICH_NOT_SET:
      break;
  }
  tid = newest;
  return newest < 0 ? ReadStatus::not_yet : ReadStatus::ok;
}

void StreamChannel::go_on_reading() {
  const SendStatus status = sender_.busy() ? sender_.go_on() : begin_reading();
  if (!reading_) return;
  switch (status) {
    case SendStatus::sent:
      sender_.end_run();
      reading_.reset();
      return;
    case SendStatus::torn:  // void, and so no answer: another one follows
    case SendStatus::not_in_ring:
      sender_.end_run();
      if (++reading_->attempts == kMaxReadAttempts) return answer_no_sample(ReadStatus::lapped);
      return parts_.observer.work_soon();
    case SendStatus::blocked:
      return sender_.end_run();
    case SendStatus::unfinished:
      return parts_.observer.work_soon();
    case SendStatus::no_memory:
      return answer_failure({Errc::limit_exceeded,
                             "read from '" + stream().id().str() +
                                 "': no memory is left to copy a sample aside; use a client that "
                                 "has the feature 'torn', or raise the key max_peer_memory"});
  }
}

// Looks for the sample that is asked for, and sends its beginning. Answers when there is none.
SendStatus StreamChannel::begin_reading() {
  if (!parts_.link.output_empty()) return SendStatus::blocked;
  Tid tid = kNoTid;
  const ReadStatus found = find(reading_->request, tid);
  if (found == ReadStatus::lapped) return SendStatus::not_in_ring;
  if (found != ReadStatus::ok) {
    answer_no_sample(found);
    return SendStatus::sent;
  }
  const SendStatus status = sender_.send(tid, reading_->serial, false);
  // A tid that was found and is lost by now does not return.
  if (status == SendStatus::not_in_ring && reading_->request.which_case() == net::Read::kTid) {
    answer_no_sample(ReadStatus::too_old);
  }
  return status;
}

void StreamChannel::answer_no_sample(ReadStatus status) {
  net::Frame frame = answer_to(reading_->serial);
  frame.mutable_no_sample()->set_status(static_cast<std::uint32_t>(status));
  reading_.reset();
  parts_.link.send(frame);
}

void StreamChannel::answer_failure(const Error& error) {
  net::Frame frame = answer_to(reading_->serial);
  wire::to_message(error, *frame.mutable_failure());
  reading_.reset();
  parts_.link.send(frame);
}

Result<void> StreamChannel::get_range(std::uint64_t serial, const net::GetRange& request) {
  net::Frame frame = answer_to(serial);
  net::Range& range = *frame.mutable_range();
  const Tid newest = newest_untrusted(reader_);
  range.set_newest(newest);
  range.set_oldest(newest < 0 ? kNoTid : std::clamp<Tid>(reader_.oldest(), 0, newest));
  range.set_at_tid(kNoTid);
  Tid tid = kNoTid;
  if (request.has_time_ns() &&
      reader_.find(time_from_ns(request.time_ns()), tid, kMaxFinds) == ReadStatus::ok) {
    range.set_at_tid(tid);
  }
  parts_.link.send(frame);
  return {};
}

// --- publishing

Result<void> StreamChannel::start_publishing(std::uint64_t serial,
                                             const net::StartPublishing& request) {
  receiver_.reset();
  receiver_ = DSSM_TRY(
      SampleReceiver::open(parts_.loop, parts_.link, parts_.budget, *served_, request.publisher()));
  DSSM_TRY(assess_writer());
  const ring::PublisherCursors::Last last = receiver_->last();
  net::Frame frame = answer_to(serial);
  net::Publishing& publishing = *frame.mutable_publishing();
  publishing.set_last(last.number);
  publishing.set_last_tid(last.tid);
  publishing.set_incarnation(stream().incarnation());
  parts_.link.send(frame);
  return {};
}

Result<void> StreamChannel::on_sample_begin(const wire::IncomingSample& sample, std::byte*& out) {
  if (!receiver_) {
    return Error{Errc::protocol,
                 "stream '" + stream().id().str() + "': a sample came before StartPublishing"};
  }
  return receiver_->on_sample_begin(sample, out);
}

Result<void> StreamChannel::on_sample_end(const wire::IncomingSample& sample, bool torn) {
  return receiver_->on_sample_end(sample, torn);
}

void StreamChannel::on_batch_end() {
  if (receiver_) receiver_->acknowledge();
}

// --- property

// From the first writer with another clock than this PC's on, the ring states what its times are
// worth.
Result<void> StreamChannel::assess_writer() {
  if (!parts_.clock) return {};
  const StreamId& id = stream().id();
  if (parts_.clock->assess_mirror(id, parts_.them.clock.get()).same_clock) return {};
  return served_->assess(parts_.clock->assess_own(id));
}

Result<void> StreamChannel::serve_property(const net::Frame& request) {
  net::Frame frame = answer_to(request.serial());
  DSSM_TRY(parts_.catalog.serve_untrusted(request, frame, parts_.account, &stream().id()));
  parts_.link.send(frame);
  return {};
}

}  // namespace dssm::daemon
