// SPDX-License-Identifier: Apache-2.0
#include "core/channel/channel_client.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <utility>

#include "core/base/try.hpp"

namespace dssm::channel {

namespace {

// The stream in `opened`, which must be `expected`.
Result<StreamInfo> opened_stream_untrusted(const proto::Opened& opened, const StreamId& expected) {
  const auto invalid = [](const Error& why) {
    return Error{Errc::protocol, "the owner's description of a stream: " + why.message};
  };
  const Result<StreamId> named = wire::stream_id_untrusted(opened.stream().id());
  if (!named) return invalid(named.error());
  const StreamId& id = *named;
  const bool is_host = expected.host.empty() || id.host == expected.host;
  if (id.name != expected.name || id.id != expected.id || !is_host) {
    return Error{Errc::protocol,
                 fmt::format("the owner opened '{}' instead of '{}'", id.str(), expected.str())};
  }
  Result<TypeInfo> type = wire::type_untrusted(opened.stream().type());
  if (!type) return invalid(type.error());
  StreamInfo stream = wire::stream_info(opened.stream());
  stream.id = id;
  stream.type = *std::move(type);
  if (stream.depth < kMinDepth || stream.depth > kMaxDepth || stream.cycle <= Duration::zero() ||
      stream.incarnation == 0 || stream.newest < kNoTid || stream.newest > kMaxTid) {
    return Error{Errc::protocol,
                 fmt::format("the owner describes '{}' as a ring of {} slots, with a cycle of {} "
                             "ns, the incarnation {} and the newest sample {}, which cannot be",
                             id.str(), stream.depth, to_ns(stream.cycle), stream.incarnation,
                             stream.newest)};
  }
  return stream;
}

}  // namespace

// --- requests

void ChannelClient::open(const StreamId& id, const CreatePlan* plan) {
  id_ = id;
  stream_ = Stream::opening;
  open_serial_ = next_serial();
  net::Frame frame;
  frame.set_serial(open_serial_);
  if (plan && plan->scope != CreatePlan::Scope::join) {
    wire::to_message(id, plan->type, plan->history, *frame.mutable_create());
    frame.mutable_create()->set_keep_existing(plan->keep_existing ||
                                              plan->scope != CreatePlan::Scope::replace);
  } else {
    wire::to_message(id, *frame.mutable_open()->mutable_id());
  }
  delegate_.send(frame);
}

void ChannelClient::subscribe(const net::Subscribe& request) {
  if (reading_ != Reading::asked) before_asked_ = reading_;
  reading_ = Reading::asked;
  subscribe_serial_ = next_serial();
  net::Frame frame;
  frame.set_serial(subscribe_serial_);
  *frame.mutable_subscribe() = request;
  delegate_.send(frame);
}

void ChannelClient::publish(std::uint64_t publisher) {
  writing_ = Writing::asked;
  publish_serial_ = next_serial();
  net::Frame frame;
  frame.set_serial(publish_serial_);
  frame.mutable_start_publishing()->set_publisher(publisher);
  delegate_.send(frame);
}

void ChannelClient::reset() noexcept {
  stream_ = Stream::closed;
  reading_ = Reading::none;
  writing_ = Writing::none;
  open_serial_ = subscribe_serial_ = publish_serial_ = 0;
  next_serial_ = 1;
}

// --- what arrives

Error ChannelClient::unexpected(std::string_view frame) {
  return {Errc::protocol, fmt::format("the owner sent {}, which is not expected now", frame)};
}

Result<void> ChannelClient::on_frame(net::Frame& frame) {
  const std::uint64_t serial = frame.serial();
  if (serial == 0) return on_event(frame);
  if (serial == open_serial_) return on_open_answer(frame);
  if (serial == subscribe_serial_) return on_subscribe_answer(frame);
  if (serial == publish_serial_) return on_publish_answer(frame);
  return delegate_.on_other_frame(frame);
}

Result<void> ChannelClient::on_open_answer(const net::Frame& frame) {
  open_serial_ = 0;
  stream_ = Stream::closed;
  if (frame.has_failure()) {
    return delegate_.on_refused(Request::open, wire::failure(frame.failure()));
  }
  if (!frame.has_opened()) return unexpected("another answer than Opened");
  StreamInfo stream = DSSM_TRY(opened_stream_untrusted(frame.opened(), id_));
  stream_ = Stream::open;
  incarnation_ = stream.incarnation;
  return delegate_.on_opened(std::move(stream), frame.opened().created());
}

Result<void> ChannelClient::on_subscribe_answer(const net::Frame& frame) {
  subscribe_serial_ = 0;
  if (frame.has_failure()) {
    reading_ = before_asked_;  // that subscription goes on
    return delegate_.on_refused(Request::subscribe, wire::failure(frame.failure()));
  }
  reading_ = Reading::none;
  if (!frame.has_subscribed()) return unexpected("another answer than Subscribed");
  if (frame.subscribed().incarnation() != incarnation_) {
    return Error{Errc::unavailable, "stream '" + id_.str() + "' was recreated just now"};
  }
  reading_ = Reading::filling;
  return delegate_.on_subscribed_untrusted(
      frame.subscribed().first_tid(), frame.subscribed().newest_first(),
      frame.subscribed().oldest(), frame.subscribed().newest());
}

Result<void> ChannelClient::on_publish_answer(const net::Frame& frame) {
  publish_serial_ = 0;
  writing_ = Writing::none;
  if (frame.has_failure()) {
    return delegate_.on_refused(Request::publish, wire::failure(frame.failure()));
  }
  if (!frame.has_publishing()) return unexpected("another answer than Publishing");
  writing_ = Writing::granted;
  return delegate_.on_published_untrusted(frame.publishing().last(), frame.publishing().last_tid(),
                                          true);
}

Result<void> ChannelClient::on_event(net::Frame& frame) {
  switch (frame.body_case()) {
    case net::Frame::kCaughtUp:
      if (reading_ == Reading::none) return unexpected("CaughtUp");
      if (reading_ == Reading::asked) return {};  // of the subscription before
      reading_ = Reading::live;
      return delegate_.on_caught_up();
    case net::Frame::kGap:
      if (reading_ == Reading::none) return unexpected("Gap");
      if (reading_ == Reading::asked) return {};  // of the subscription before
      return delegate_.on_gap_untrusted(frame.gap().first_tid(), frame.gap().count());
    case net::Frame::kPublished:
      if (writing_ == Writing::none) return unexpected("Published");
      return delegate_.on_published_untrusted(frame.published().last(),
                                              frame.published().last_tid(), false);
    case net::Frame::kEnded:
      return delegate_.on_ended(
          {Errc::not_found, "stream '" + id_.str() + "' was removed on its owner's host"});
    case net::Frame::kFailure:
      return wire::failure(frame.failure()).context("the owner closed the connection");
    case net::Frame::kOpened:
    case net::Frame::kSubscribed:
    case net::Frame::kPublishing:
      return unexpected("an answer that was not asked for");
    default:
      return delegate_.on_other_frame(frame);
  }
}

void SampleCursor::resume(std::uint64_t incarnation, net::Subscribe& out) const {
  if (next_ == kNoTid) return out.set_from_oldest(true);
  out.set_from_tid(next_);
  out.set_incarnation(incarnation);
}

Result<void> SampleCursor::on_subscribed_untrusted(Tid first) {
  if (first < std::max<Tid>(next_, 0) || first > kMaxTid) {
    return Error{Errc::protocol,
                 fmt::format("the owner begins the subscription with sample {}", first)};
  }
  if (next_ != kNoTid && !is_thinned_) lost_ += static_cast<std::uint64_t>(first - next_);
  next_ = first;
  return {};
}

Error SampleCursor::unexpected(Tid tid) const {
  return {Errc::protocol,
          fmt::format("sample {} came instead of sample {} or a later one", tid, next_)};
}

Result<Tid> SampleCursor::end_of_gap_untrusted(Tid first, std::uint64_t count) {
  if (first < 0 || first > kMaxTid || count > static_cast<std::uint64_t>(kMaxTid - first)) {
    return Error{
        Errc::protocol,
        fmt::format("the owner reports a gap of {} samples from sample {} on", count, first)};
  }
  return first + static_cast<Tid>(count);
}

Result<void> SampleCursor::on_gap_untrusted(Tid first, std::uint64_t count) {
  const Tid end = DSSM_TRY(end_of_gap_untrusted(first, count));
  if (end <= next_) {
    return Error{Errc::protocol,
                 fmt::format("the owner reports the samples before {} as lost, but sample {} has "
                             "come already",
                             end, next_ - 1)};
  }
  lost_ += static_cast<std::uint64_t>(end - (is_thinned_ ? std::max(first, next_) : next_));
  next_ = end;
  return {};
}

}  // namespace dssm::channel
