// SPDX-License-Identifier: Apache-2.0
#include "client/src/channel.hpp"

#include <poll.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>

#include "client/src/find_host.hpp"
#include "client/src/program_name.hpp"
#include "core/base/timespec.hpp"

namespace dssm::detail {
namespace {

using namespace std::chrono_literals;

// Between attempts to set up a connection.
constexpr Duration kFirstPause = 10ms;
constexpr Duration kLongestPause = 1s;
// How long next() stays with a large sample that has begun to arrive in the caller's memory, before
// it puts aside what has come: 10 MB at 1 GB/s. The last wait within that time may end
// Transport::kReceiveWait after it, which makes the 20 ms that pconnector.hpp tells.
constexpr Duration kStayWithSample = 10ms;
static_assert(kStayWithSample + wire::Transport::kReceiveWait <= 20ms);

// post() looks for acknowledgements once in so many calls.
constexpr unsigned kPostsPerReceive = 32;

constexpr Duration kCloseTimeout = 1s;  // ~Channel sends what was posted for so long

Result<StreamInfo> stream_untrusted(const proto::Stream& message) {
  auto id = wire::stream_id_untrusted(message.id());
  if (!id) return std::move(id).error();
  auto type = wire::type_untrusted(message.type());
  if (!type) return std::move(type).error();
  if (message.depth() < kMinDepth || message.depth() > kMaxDepth) {
    return Error{Errc::protocol, "a ring of " + std::to_string(message.depth()) + " slots"};
  }
  StreamInfo info = wire::stream_info(message);
  info.id = std::move(*id);
  info.type = std::move(*type);
  return info;
}

}  // namespace

Channel::Channel(Goal goal, PConnectorOptions options)
    : goal_(std::move(goal)),
      options_(std::move(options)),
      owner_pid_(::getpid()),
      link_(*this, options_.program.empty() ? default_program() : options_.program,
            options_.request_timeout),
      publisher_(wire::random_number()) {}

Result<std::unique_ptr<Channel>> Channel::open(Goal goal, PConnectorOptions options) {
  std::unique_ptr<Channel> channel(new Channel(std::move(goal), std::move(options)));
  const StreamId& id = channel->goal_.id;
  const std::string& address =
      channel->options_.address.empty() ? id.host : channel->options_.address;
  auto host = parse_host(address);
  if (!host) return std::move(host).error();
  channel->host_ = std::move(*host);
  const auto tried = [&] { return channel->is_up() || channel->failed_attempts_ > 0; };
  static_cast<void>(channel->run(deadline_in(channel->options_.request_timeout), false, tried));
  if (channel->is_up()) return channel;
  if (channel->why_down_) return *channel->why_down_;
  return channel->link_.silence();
}

Channel::~Channel() {
  if (::getpid() != owner_pid_) return;
  if (outbox_ && !outbox_->all_written()) static_cast<void>(flush(deadline_in(kCloseTimeout)));
}

// --- the connection

[[gnu::hot]] bool Channel::is_up() const noexcept {
  return link_.is_up() && opened_ && subscribe_serial_ == 0 && publishing_serial_ == 0;
}

Result<void> Channel::begin_connecting(Patience patience) {
  if (patience == Patience::some || addresses_.empty()) {
    auto found = find_host(*host_);
    if (!found) return std::move(found).error();
    addresses_ = std::move(*found);
  }
  link_.start(addresses_);
  return {};
}

void Channel::set_up() {
  set_up_sent_ = true;
  set_up_deadline_ = deadline_in(options_.request_timeout);
  net::Frame frame;
  open_serial_ = next_serial_++;
  frame.set_serial(open_serial_);
  if (goal_.type) {
    wire::to_message(goal_.id, *frame.mutable_create()->mutable_id());
    wire::to_message(*goal_.type, *frame.mutable_create()->mutable_type());
    frame.mutable_create()->set_depth(goal_.history.depth);
    frame.mutable_create()->set_cycle_ns(to_ns(goal_.history.cycle));
  } else {
    wire::to_message(goal_.id, *frame.mutable_open()->mutable_id());
  }
  link_.queue(frame);
  if (subscriber_ && subscriber_->active()) request_subscription();
  if (publishes_) start_publishing();
}

void Channel::note_up() {
  if (was_up_ || !is_up()) return;
  was_up_ = true;
  ++connections_;
  set_up_deadline_ = kNever;
  why_down_.reset();
}

void Channel::forget_connection() {
  link_.close();
  set_up_sent_ = opened_ = was_up_ = useful_ = held_ = may_publish_ = false;
  open_serial_ = subscribe_serial_ = publishing_serial_ = ask_serial_ = 0;
  set_up_deadline_ = kNever;
  if (subscriber_) subscriber_->on_down();
  if (outbox_) outbox_->on_down();
}

void Channel::went_down(Error why) {
  if (!was_up_) ++failed_attempts_;
  // A connection that brought something was a good one: the next is tried without a pause.
  pause_ = useful_ ? Duration(0) : std::clamp(2 * pause_, kFirstPause, kLongestPause);
  retry_at_ = MonoClock::now() + pause_;
  why_down_ = std::move(why);
  forget_connection();
}

[[gnu::hot]] void Channel::advance(Patience patience) {
  if (link_.is_down()) {
    if (MonoClock::now() < retry_at_) return;
    if (Result<void> begun = begin_connecting(patience); !begun) {
      return went_down(std::move(begun).error());
    }
  }
  if (!link_.is_up()) {
    if (Result<void> done = link_.advance(); !done) return went_down(std::move(done).error());
    if (!link_.is_up()) return;
  }
  if (!set_up_sent_) set_up();
  if (set_up_deadline_ != kNever && MonoClock::now() >= set_up_deadline_ && !link_.has_arrived()) {
    return went_down(link_.silence());
  }
  if (Result<void> sent = send_all(); !sent) went_down(std::move(sent).error());
}

// Frames are whole before the next one begins, whatever they are.
Result<void> Channel::send_all() {
  for (;;) {
    if (outbox_) {
      const auto rest = outbox_->rest_of_frame();
      auto sent = link_.send_some(rest);
      if (!sent) return std::move(sent).error();
      outbox_->sent(*sent);
      if (*sent < rest.size()) return {};
    }
    if (link_.has_queued()) {
      if (Result<void> sent = link_.send_queued(); !sent) return sent;
      if (link_.has_queued()) return {};
    }
    if (!may_publish_) return {};
    const auto unsent = outbox_->unsent();
    if (unsent.empty()) return {};
    auto sent = link_.send_some(unsent);
    if (!sent) return std::move(sent).error();
    outbox_->sent(*sent);
    if (*sent < unsent.size()) return {};
  }
}

bool Channel::has_more_to_send() const noexcept {
  return outbox_ &&
         (!outbox_->rest_of_frame().empty() || (may_publish_ && !outbox_->unsent().empty()));
}

// Takes what has come, once. False: nothing has, or the connection broke.
[[gnu::hot]] bool Channel::receive() {
  if (std::exchange(held_, false)) {
    if (Result<void> done = link_.resume(); !done) return went_down(std::move(done).error()), false;
    return true;
  }
  return on_received(link_.receive()) == wire::IoStatus::ok;
}

// Whether there is nothing to do but to wait for what comes: then receive_waiting() saves a system
// call.
[[gnu::hot]] bool Channel::may_wait_in_receive() const noexcept {
  return is_up() && !held_ && !link_.has_queued() && !has_more_to_send();
}

// Takes what comes within Transport::kReceiveWait. After may_wait_in_receive().
//   returns  ok | would_block | interrupted | end: the connection broke
[[gnu::hot]] wire::IoStatus Channel::receive_waiting() {
  return on_received(link_.receive_waiting());
}

// The same, for what follows at once if it follows at all: the rest of a sample, the next one.
[[gnu::hot]] wire::IoStatus Channel::receive_watching() {
  return on_received(link_.receive_watching());
}

[[gnu::hot]] wire::IoStatus Channel::on_received(const Result<wire::IoStatus>& received) {
  if (!received) return went_down(received.error()), wire::IoStatus::end;
  // It may have been the greeting.
  if (*received == wire::IoStatus::ok && !set_up_sent_) advance(Patience::none);
  return *received;
}

MonoTime Channel::next_step() const noexcept {
  return link_.is_down() ? retry_at_ : std::min(link_.next_step(), set_up_deadline_);
}

// Works on the connection until done() or the deadline; at least once.
template <class Done>
WaitStatus Channel::run(MonoTime deadline, bool interruptible, Done done) {
  for (;;) {
    advance(Patience::some);
    if (done()) return WaitStatus::ready;
    if (held_) {
      receive();
      continue;
    }
    const MonoTime until = std::min(deadline, next_step());
    const timespec timeout = timespec_of(until - MonoClock::now());
    pollfd ready{link_.fd(), link_.events(has_more_to_send()), 0};
    const int count = ::ppoll(&ready, 1, until == kNever ? nullptr : &timeout, nullptr);
    if (count > 0) {
      if (ready.revents & (POLLIN | POLLHUP | POLLERR)) receive();
    } else if (count < 0 && errno == EINTR && interruptible) {
      return done() ? WaitStatus::ready : WaitStatus::interrupted;
    } else if (deadline != kNever && MonoClock::now() >= deadline) {
      return WaitStatus::timeout;
    }
  }
}

Result<void> Channel::get_up(MonoTime deadline) {
  if (is_up()) return {};
  subscriber_->keep(true);
  const std::uint64_t before = failed_attempts_;
  static_cast<void>(run(deadline, false, [&] { return is_up() || is_hopeless_since(before); }));
  if (is_up()) return {};
  if (is_hopeless_since(before)) return *why_down_;
  return away("is away and did not come back in time");
}

// Whether an attempt to connect failed, after there had been `failed_before`, in a way that trying
// again soon does not mend.
bool Channel::is_hopeless_since(std::uint64_t failed_before) const noexcept {
  return failed_attempts_ != failed_before && why_down_ && !is_retryable(why_down_->code);
}

Error Channel::away(const std::string& how) const {
  std::string message = "dssmd at '" + address() + "' " + how;
  if (why_down_) message += " (" + why_down_->message + ")";
  return Error{Errc::unavailable, message};
}

std::string Channel::what(const char* verb) const { return verb + (" '" + stream_.id.str() + "'"); }

// --- what arrives

Result<void> Channel::on_opened(const net::Frame& frame) {
  open_serial_ = 0;
  if (frame.has_failure()) return wire::failure(frame.failure());
  if (!frame.has_opened()) {
    return Error{Errc::protocol, "dssmd answered something else than the opened stream"};
  }
  auto stream = stream_untrusted(frame.opened().stream());
  if (!stream) return std::move(stream).error().context("dssmd's description of the stream");
  if (!subscriber_) {
    subscriber_ = std::make_unique<Subscriber>(stream->type.payload_bytes);
    outbox_ = std::make_unique<Outbox>(stream->type.payload_bytes, options_.max_unsent_samples,
                                       options_.max_unsent_bytes);
  } else {
    if (Result<void> usable = stream->type.check_usable_as(stream_.type); !usable) {
      return std::move(usable).error().context("the stream was created anew");
    }
    if (stream->incarnation != stream_.incarnation) {
      ++restarts_;
      restart_untold_ = true;
      subscriber_->on_restart();
    }
  }
  stream_ = std::move(*stream);
  link_.set_payload_bytes(stream_.type.payload_bytes);
  opened_ = true;
  return {};
}

Result<void> Channel::on_event(const net::Frame& frame) {
  if (frame.has_failure()) return wire::failure(frame.failure()).context("last words of dssmd");
  if (frame.has_ended()) return Error{Errc::not_found, "the stream was removed"};
  if (!subscriber_) return {};
  if (frame.has_gap()) subscriber_->on_gap(frame.gap());
  if (frame.has_published()) {
    useful_ = true;
    return outbox_->acknowledge(frame.published().last(), frame.published().last_tid());
  }
  return {};
}

Result<void> Channel::on_frame(net::Frame& frame) {
  const std::uint64_t serial = frame.serial();
  if (serial == 0) return on_event(frame);
  Result<void> result;
  if (serial == open_serial_) {
    result = on_opened(frame);
  } else if (serial == subscribe_serial_) {
    subscribe_serial_ = 0;
    if (frame.has_failure()) {
      subscription_refused_ = wire::failure(frame.failure());
      subscriber_->end();
    } else {
      result = subscriber_->on_subscribed(frame.subscribed());
    }
  } else if (serial == publishing_serial_) {
    publishing_serial_ = 0;
    if (frame.has_failure()) return wire::failure(frame.failure()).context("publish");
    // One that was allowed to begin before has nothing to go back to.
    if (!may_publish_) {
      result = outbox_->restart(frame.publishing().last(), frame.publishing().last_tid());
    }
    may_publish_ = true;
  } else if (serial == ask_serial_) {
    answer_ = std::move(frame);
    ask_serial_ = 0;
    answered_ = useful_ = true;
  }
  if (result) note_up();
  return result;
}

[[gnu::hot]] Result<void> Channel::on_sample_begin(const wire::IncomingSample& sample,
                                                   std::byte*& out) {
  if (sample.serial != 0) {
    out = sample.serial == ask_serial_ ? read_target_ : nullptr;
    return {};
  }
  auto has_place = subscriber_->on_sample_begin(sample.info, out);
  if (!has_place) return std::move(has_place).error();
  if (*has_place) return {};
  held_ = true;
  link_.decoder().hold();
  return {};
}

[[gnu::hot]] Result<void> Channel::on_sample_end(const wire::IncomingSample& sample, bool torn) {
  useful_ = true;
  if (sample.serial == 0) return subscriber_->on_sample_end(sample.info, torn), Result<void>();
  if (sample.serial != ask_serial_ || !read_target_) return {};
  read_info_ = sample.info;
  read_torn_ = torn;
  ask_serial_ = 0;
  answered_ = true;
  return {};
}

// --- requests

template <class Queue>
Result<void> Channel::exchange(Queue queue) {
  const MonoTime deadline = deadline_in(options_.request_timeout);
  for (;;) {
    if (Result<void> up = get_up(deadline); !up) return up;
    subscriber_->keep(true);
    answered_ = false;
    read_info_.reset();
    ask_serial_ = next_serial_++;
    queue(ask_serial_);
    const auto done = [&] { return answered_ || ask_serial_ == 0; };
    advance(Patience::none);
    // The answer comes within a round trip, nearly always.
    while (!done() && may_wait_in_receive() && receive_waiting() == wire::IoStatus::ok &&
           MonoClock::now() < deadline) {
    }
    const WaitStatus status = run(deadline, false, done);
    if (answered_) return {};
    if (status == WaitStatus::timeout) {
      // A late answer must not meet memory that is the caller's again.
      Error error = away("does not answer");
      went_down(error);
      return error;
    }
    if (why_down_ && !is_retryable(why_down_->code)) return *why_down_;
  }
}

Result<net::Frame> Channel::ask(net::Frame request) {
  read_target_ = nullptr;
  const auto queue = [&](std::uint64_t serial) {
    request.set_serial(serial);
    link_.queue(request);
  };
  if (Result<void> done = exchange(queue); !done) return std::move(done).error();
  if (answer_.has_failure()) return wire::failure(answer_.failure());
  return std::move(answer_);
}

Result<ReadStatus> Channel::read(const ReadRequest& request, std::span<std::byte> payload,
                                 SampleInfo& info) {
  if (payload.size() != stream_.type.payload_bytes) {
    return Error{Errc::invalid_argument, what("read") + ": its samples have " +
                                             std::to_string(stream_.type.payload_bytes) +
                                             " bytes, not " + std::to_string(payload.size())};
  }
  for (;;) {
    if (std::exchange(restart_untold_, false)) return ReadStatus::restarted;
    read_target_ = payload.data();
    Result<void> done = exchange([&](std::uint64_t serial) {
      std::array<std::byte, kMaxReadRequestBytes> bytes;
      link_.queue(std::span(bytes).first(encode_read_request(bytes, serial, request)));
    });
    read_target_ = nullptr;
    if (!done) return std::move(done).error().context(what("read"));
    if (restart_untold_) continue;  // what was asked for was another ring's
    if (read_info_) {
      if (read_torn_) continue;
      info = *read_info_;
      return ReadStatus::ok;
    }
    if (answer_.has_failure()) return wire::failure(answer_.failure()).context(what("read"));
    const std::uint32_t status = answer_.no_sample().status();
    if (status < 1 || status > static_cast<std::uint32_t>(ReadStatus::lapped)) {
      return Error{Errc::protocol, what("read") + ": dssmd answered neither a sample nor why not"};
    }
    return static_cast<ReadStatus>(status);
  }
}

// --- the subscription

void Channel::request_subscription() {
  net::Frame frame;
  subscribe_serial_ = next_serial_++;
  frame.set_serial(subscribe_serial_);
  subscriber_->to_message(stream_.incarnation, *frame.mutable_subscribe());
  link_.queue(frame);
}

Result<void> Channel::subscribe(const Subscription& what_from) {
  const MonoTime deadline = deadline_in(options_.request_timeout);
  if (Result<void> up = get_up(deadline); !up) {
    return std::move(up).error().context(what("subscribe to"));
  }
  subscription_refused_.reset();
  subscriber_->begin(what_from);
  subscriber_->keep(true);
  request_subscription();
  static_cast<void>(run(deadline, false, [&] { return is_up() || link_.is_down(); }));
  if (!subscriber_->granted() && !subscription_refused_) {
    if (Result<void> up = get_up(deadline); !up) {
      subscriber_->end();
      return std::move(up).error().context(what("subscribe to"));
    }
  }
  if (subscription_refused_) return Error(*subscription_refused_).context(what("subscribe to"));
  return {};
}

Result<void> Channel::unsubscribe() {
  if (!subscriber_->active()) return {};
  subscriber_->end();
  forget_connection();
  retry_at_ = MonoClock::now();
  return get_up(deadline_in(options_.request_timeout));
}

[[gnu::hot]] Result<ReadStatus> Channel::next(std::span<std::byte> payload, SampleInfo& info) {
  if (payload.size() != stream_.type.payload_bytes) {
    return Error{Errc::invalid_argument, what("read") + ": its samples have " +
                                             std::to_string(stream_.type.payload_bytes) +
                                             " bytes, not " + std::to_string(payload.size())};
  }
  if (!subscriber_->active()) {
    if (subscription_refused_) return Error(*subscription_refused_).context(what("subscribe to"));
    return Error{Errc::invalid_argument, what("read") + ": call subscribe() before read_next()"};
  }
  if (auto kept = subscriber_->take_kept(payload, info)) return *kept;
  subscriber_->keep(false);
  subscriber_->set_target(payload.data());
  auto result = take_next(payload, info);
  if (subscriber_->is_filling_target()) link_.decoder().move_payload(subscriber_->leave_target());
  subscriber_->set_target(nullptr);
  return result;
}

[[gnu::hot]] Result<ReadStatus> Channel::take_next(std::span<std::byte> payload, SampleInfo& info) {
  if (!held_) advance(Patience::none);
  for (MonoTime stay_until = kNever;;) {
    // The rest is on its way: to wait for it here saves a copy of all of it.
    const bool waits = subscriber_->is_filling_target() && may_wait_in_receive();
    if (waits && stay_until == kNever) stay_until = deadline_in(kStayWithSample);
    const bool received = waits ? receive_watching() == wire::IoStatus::ok : receive();
    if (subscriber_->taken(info)) return ReadStatus::ok;
    if (auto kept = subscriber_->take_kept(payload, info)) return *kept;
    if (!received || (waits && MonoClock::now() >= stay_until)) break;
  }
  if (is_up()) return ReadStatus::not_yet;
  Error error = why_down_ ? *why_down_ : Error{Errc::unavailable, "the connection is being set up"};
  if (error.code != Errc::not_found) error.code = Errc::unavailable;
  return std::move(error).context(what("read"));
}

[[gnu::hot]] WaitStatus Channel::wait(MonoTime deadline) {
  if (!subscriber_->active()) return WaitStatus::timeout;
  subscriber_->keep(false);
  const std::uint64_t before = failed_attempts_;
  const auto done = [&] { return held_ || subscriber_->has_kept() || is_hopeless_since(before); };
  // Mostly the next sample comes soon. After that time poll(), which does not wake up for nothing.
  if (!done() && may_wait_in_receive() &&
      (deadline == kNever || deadline - MonoClock::now() >= wire::Transport::kReceiveWait)) {
    const wire::IoStatus status = receive_watching();
    if (status == wire::IoStatus::interrupted) return WaitStatus::interrupted;
  }
  return run(deadline, true, done);
}

int Channel::fd() noexcept {
  if (!readiness_) {
    auto made = Readiness::make();
    if (!made) return link_.fd();
    readiness_ = std::move(*made);
  }
  const bool has_one = held_ || subscriber_->has_kept();
  readiness_->follow(link_.fd(), link_.events(has_more_to_send()),
                     has_one ? MonoTime::min() : next_step());
  return readiness_->fd();
}

// --- publishing

void Channel::start_publishing() {
  net::Frame frame;
  publishing_serial_ = next_serial_++;
  frame.set_serial(publishing_serial_);
  frame.mutable_start_publishing()->set_publisher(publisher_);
  link_.queue(frame);
  // The owner knows nothing of a new publisher, so there is nothing to wait for.
  may_publish_ = !publishes_;
  publishes_ = true;
}

Result<void> Channel::post(std::span<const std::byte> payload, Time time, Duration clock_error) {
  if (payload.size() != stream_.type.payload_bytes) {
    return Error{Errc::invalid_argument, what("write") + ": its samples have " +
                                             std::to_string(stream_.type.payload_bytes) +
                                             " bytes, not " + std::to_string(payload.size())};
  }
  if (!publishes_) {
    if (is_up()) {
      start_publishing();
    } else {
      publishes_ = true;
    }
  }
  outbox_->push(payload, time, clock_error);
  advance(Patience::none);
  // What did not go tells that the other side is slow, or gone.
  if (++posts_since_receive_ < kPostsPerReceive && !has_more_to_send()) return {};
  posts_since_receive_ = 0;
  subscriber_->keep(true);
  while (receive()) {
  }
  return {};
}

Result<Tid> Channel::flush(MonoTime deadline) {
  if (outbox_->newest() < 0) return kNoTid;
  subscriber_->keep(true);
  const std::uint64_t before = failed_attempts_;
  static_cast<void>(
      run(deadline, false, [&] { return outbox_->all_written() || is_hopeless_since(before); }));
  if (outbox_->all_written()) return outbox_->written_tid();
  if (is_hopeless_since(before)) return Error(*why_down_).context(what("write"));
  return away("did not take all samples in time; they are kept and sent when it does")
      .context(what("write"));
}

PConnector::Counters Channel::counters() const noexcept {
  const wire::DecoderCounters counters = link_.counters();
  return {counters.samples, counters.copied_payload_bytes + subscriber_->copied_bytes(),
          counters.direct_payload_bytes, connections_ > 0 ? connections_ - 1 : 0};
}

}  // namespace dssm::detail
