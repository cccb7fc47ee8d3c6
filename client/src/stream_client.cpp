// SPDX-License-Identifier: Apache-2.0
#include "client/src/stream_client.hpp"

#include <fmt/format.h>
#include <poll.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>

#include "client/src/find_host.hpp"
#include "client/src/program_name.hpp"
#include "core/base/time.hpp"
#include "core/base/try.hpp"

namespace dssm::detail {
namespace {

using namespace std::chrono_literals;

// How long next() receives a large sample that has begun to arrive in the caller's memory, before
// it moves what has arrived to a buffer: 10 MB at 1 GB/s. The last wait within that time may end
// Transport::kReceiveWait after it: the 20 ms that pconnector.hpp promises.
constexpr Duration kMaxStayWithSample = 10ms;
static_assert(kMaxStayWithSample + wire::Transport::kReceiveWait <= 20ms);

// post() receives acknowledgements once in so many calls.
constexpr unsigned kPostsPerReceive = 32;

constexpr Duration kCloseTimeout = 1s;  // how long ~StreamClient sends posted samples

}  // namespace

StreamClient::StreamClient(Goal goal, PConnectorOptions options, ClientCredentials credentials)
    : goal_(std::move(goal)),
      options_(std::move(options)),
      owner_pid_(::getpid()),
      connection_(*this, options_.program.empty() ? default_program() : options_.program,
                  // A busy dssmd may greet late.
                  std::max(options_.request_timeout, wire::kHelloTimeout), std::move(credentials)) {
  publishing_.publisher = wire::random_number();
}

Result<std::unique_ptr<StreamClient>> StreamClient::open(Goal goal, PConnectorOptions options) {
  ClientCredentials credentials = DSSM_TRY(load_credentials(options.credentials));
  std::unique_ptr<StreamClient> client(
      new StreamClient(std::move(goal), std::move(options), std::move(credentials)));
  const StreamId& id = client->goal_.id;
  const std::string& address =
      client->options_.address.empty() ? id.host : client->options_.address;
  client->host_.name = DSSM_TRY(parse_host(address));
  const auto tried = [&] { return client->is_up() || client->attempts_.failed > 0; };
  static_cast<void>(client->run(deadline_in(client->options_.request_timeout), false, tried));
  if (client->is_up()) return client;
  if (client->attempts_.last_error) return *client->attempts_.last_error;
  return client->connection_.no_answer_error();
}

StreamClient::~StreamClient() {
  if (::getpid() != owner_pid_) return;
  if (outbox_ && !outbox_->all_written()) static_cast<void>(flush(deadline_in(kCloseTimeout)));
}

// --- the connection

[[gnu::hot]] bool StreamClient::is_up() const noexcept {
  return connection_.is_up() && channel_.is_settled();
}

Result<void> StreamClient::start_connecting(LookUp look_up) {
  if (look_up == LookUp::yes || host_.addresses.empty()) {
    auto found = find_host(*host_.name);
    if (!found) return connection_.start(std::move(found));
    host_.addresses = *std::move(found);
  }
  return connection_.start(host_.addresses);
}

void StreamClient::check_up() {
  if (setup_.was_up || !is_up()) return;
  setup_.was_up = true;
  ++attempts_.succeeded;
  setup_.deadline = kNever;
  attempts_.last_error.reset();
}

void StreamClient::forget_connection() {
  connection_.close();
  setup_ = {};
  channel_.reset();
  sample_waits_ = publishing_.allowed = false;
  request_.serial = 0;
  if (subscriber_) subscriber_->on_down();
  if (outbox_) outbox_->on_down();
}

void StreamClient::on_disconnected(Error error) {
  if (!setup_.was_up) ++attempts_.failed;
  attempts_.last_error = std::move(error);
  forget_connection();
}

[[gnu::hot]] void StreamClient::advance(LookUp look_up) {
  if (connection_.is_down()) {
    if (MonoClock::now() < connection_.next_step()) return;
    if (Result<void> begun = start_connecting(look_up); !begun) {
      return on_disconnected(std::move(begun).error());
    }
  }
  if (!connection_.is_up()) {
    if (Result<void> done = connection_.advance(); !done)
      return on_disconnected(std::move(done).error());
    if (!connection_.is_up()) return;
  }
  if (channel_.stream() == channel::ChannelClient::Stream::closed) {
    setup_.deadline = deadline_in(options_.request_timeout);
    channel_.open(goal_.id, goal_.plan ? &*goal_.plan : nullptr);
  }
  if (setup_.deadline != kNever && MonoClock::now() >= setup_.deadline &&
      !connection_.has_arrived()) {
    return on_disconnected(connection_.no_answer_error());
  }
  if (Result<void> sent = send_all(); !sent) on_disconnected(std::move(sent).error());
}

// A frame is sent completely before the next one begins.
Result<void> StreamClient::send_all() {
  for (;;) {
    if (outbox_) {
      const auto rest = outbox_->rest_of_frame();
      const std::size_t sent = DSSM_TRY(connection_.send_some(rest));
      outbox_->sent(sent);
      if (sent < rest.size()) return {};
    }
    if (connection_.has_queued()) {
      DSSM_TRY(connection_.send_queued());
      if (connection_.has_queued()) return {};
    }
    if (!publishing_.allowed) return {};
    const auto unsent = outbox_->unsent();
    if (unsent.empty()) return {};
    const std::size_t sent = DSSM_TRY(connection_.send_some(unsent));
    outbox_->sent(sent);
    if (sent < unsent.size()) return {};
  }
}

bool StreamClient::has_more_to_send() const noexcept {
  return outbox_ &&
         (!outbox_->rest_of_frame().empty() || (publishing_.allowed && !outbox_->unsent().empty()));
}

// Receives once. False: nothing has arrived, or the connection ended.
[[gnu::hot]] bool StreamClient::receive() {
  if (std::exchange(sample_waits_, false)) {
    if (Result<void> done = connection_.resume(); !done)
      return on_disconnected(std::move(done).error()), false;
    return true;
  }
  return on_received(connection_.receive()) == wire::IoStatus::ok;
}

// Whether receiving is all there is to do: then receive_waiting() saves a system call.
[[gnu::hot]] bool StreamClient::may_wait_in_receive() const noexcept {
  return is_up() && !sample_waits_ && !connection_.has_queued() && !has_more_to_send();
}

// Receives what arrives within Transport::kReceiveWait. Only if may_wait_in_receive().
//   returns  ok | would_block | interrupted | end (the connection ended)
[[gnu::hot]] wire::IoStatus StreamClient::receive_waiting() {
  return on_received(connection_.receive_waiting());
}

// The same for what follows at once, if at all: the rest of a sample, or the next one.
[[gnu::hot]] wire::IoStatus StreamClient::receive_spinning() {
  return on_received(connection_.receive_spinning());
}

[[gnu::hot]] wire::IoStatus StreamClient::on_received(const Result<wire::IoStatus>& received) {
  if (!received) return on_disconnected(received.error()), wire::IoStatus::end;
  // It may have been the greeting, or the answer to Open.
  const bool is_closed = channel_.stream() == channel::ChannelClient::Stream::closed;
  if (*received == wire::IoStatus::ok && (is_closed || connection_.has_queued())) {
    advance(LookUp::no);
  }
  return *received;
}

MonoTime StreamClient::next_step() const noexcept {
  return std::min(connection_.next_step(), setup_.deadline);
}

template <class Done>
WaitStatus StreamClient::run(MonoTime deadline, bool interruptible, Done done) {
  for (;;) {
    advance(LookUp::yes);
    if (done()) return WaitStatus::ready;
    if (sample_waits_ || connection_.has_buffered_input()) {
      receive();
      continue;
    }
    const MonoTime until = std::min(deadline, next_step());
    const timespec timeout = timespec_of(until - MonoClock::now());
    pollfd ready{connection_.fd(), connection_.events(has_more_to_send()), 0};
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

Result<void> StreamClient::wait_until_up(MonoTime deadline) {
  if (is_up()) return {};
  subscriber_->set_buffering(true);
  const std::uint64_t before = attempts_.failed;
  static_cast<void>(run(deadline, false, [&] { return is_up() || has_failed_since(before); }));
  if (is_up()) return {};
  if (has_failed_since(before)) return *attempts_.last_error;
  return unavailable_error("is unavailable");
}

// Whether an attempt after the first `failed_before` failed ones failed with an error that is not
// retryable.
bool StreamClient::has_failed_since(std::uint64_t failed_before) const noexcept {
  return attempts_.failed != failed_before && attempts_.last_error &&
         !is_retryable(attempts_.last_error->code);
}

Error StreamClient::unavailable_error(const std::string& reason) const {
  std::string message = fmt::format("dssmd at '{}' {}", address(), reason);
  if (attempts_.last_error) message += fmt::format(" ({})", attempts_.last_error->message);
  return Error{Errc::unavailable, message};
}

std::string StreamClient::what(const char* verb) const {
  return fmt::format("{} '{}'", verb, stream_.id.str());
}

Error StreamClient::size_error(const char* verb, std::size_t bytes) const {
  return Error{Errc::invalid_argument, fmt::format("{}: its samples have at most {} bytes, not {}",
                                                   what(verb), stream_.type.payload_bytes, bytes)};
}

// --- protocol: what arrives

Result<void> StreamClient::on_frame(net::Frame& frame) {
  DSSM_TRY(channel_.on_frame(frame));
  check_up();
  return {};
}

Result<void> StreamClient::on_opened(StreamInfo stream, bool) {
  // The answer names its host as it likes; the certificate does not.
  const wire::CertifiedPeer* peer = connection_.peer();
  if (peer && peer->name != stream.id.host) {
    return Error{Errc::no_permission, peer->str() + " opened '" + stream.id.str() +
                                          "', which is of another host than its certificate"};
  }
  if (!subscriber_) {
    subscriber_ = std::make_unique<Subscriber>(stream.type.payload_bytes);
    outbox_ = std::make_unique<Outbox>(stream.type.payload_bytes, options_.max_unsent_samples,
                                       options_.max_unsent_bytes);
  } else {
    DSSM_TRY(stream.type.check_usable_as(stream_.type), "the stream was recreated");
    if (stream.incarnation != stream_.incarnation) {
      ++restart_.count;
      restart_.pending = true;
      subscriber_->on_restart();
    }
  }
  stream_ = std::move(stream);
  connection_.set_payload_bytes(stream_.type.payload_bytes);
  if (subscriber_->active()) request_subscription();
  if (publishing_.started) start_publishing();
  return {};
}

Result<void> StreamClient::on_subscribed_untrusted(Tid first, bool /*newest_first*/, Tid /*oldest*/,
                                                   Tid /*newest*/) {
  return subscriber_->on_subscribed_untrusted(first);
}

Result<void> StreamClient::on_gap_untrusted(Tid first, std::uint64_t count) {
  return subscriber_->on_gap_untrusted(first, count);
}

Result<void> StreamClient::on_published_untrusted(std::int64_t last, Tid last_tid, bool begins) {
  if (!begins) {
    connection_.mark_useful();
    return outbox_->acknowledge(last, last_tid);
  }
  // A new publisher was allowed at once and has nothing to send again.
  return std::exchange(publishing_.allowed, true) ? Result<void>()
                                                  : outbox_->restart(last, last_tid);
}

Result<void> StreamClient::on_refused(channel::ChannelClient::Request request, const Error& why) {
  if (request == channel::ChannelClient::Request::open) return why;
  if (request == channel::ChannelClient::Request::publish) return Error(why).context("publish");
  subscription_refused_ = why;
  subscriber_->end();
  return {};
}

Result<void> StreamClient::on_other_frame(net::Frame& frame) {
  if (frame.serial() == 0 || frame.serial() != request_.serial) return {};
  connection_.mark_useful();
  request_.answer = std::move(frame);
  request_.serial = 0;
  request_.answered = true;
  return {};
}

[[gnu::hot]] Result<void> StreamClient::on_sample_begin(const wire::IncomingSample& sample,
                                                        std::byte*& out) {
  if (sample.serial != 0) {
    out = sample.serial == request_.serial ? request_.target : nullptr;
    return {};
  }
  auto has_place = subscriber_->on_sample_begin(sample.info, out);
  if (!has_place) return std::move(has_place).error();
  if (*has_place) return {};
  sample_waits_ = true;
  connection_.decoder().hold();
  return {};
}

[[gnu::hot]] Result<void> StreamClient::on_sample_end(const wire::IncomingSample& sample,
                                                      bool torn) {
  connection_.mark_useful();
  if (sample.serial == 0) return subscriber_->on_sample_end(sample.info, torn), Result<void>();
  if (sample.serial != request_.serial || !request_.target) return {};
  request_.info = sample.info;
  request_.torn = torn;
  request_.serial = 0;
  request_.answered = true;
  return {};
}

// --- requests

template <class Queue>
Result<void> StreamClient::exchange(Queue queue) {
  const MonoTime deadline = deadline_in(options_.request_timeout);
  for (;;) {
    DSSM_TRY(wait_until_up(deadline));
    subscriber_->set_buffering(true);
    request_.answered = false;
    request_.info.reset();
    request_.serial = channel_.next_serial();
    queue(request_.serial);
    const auto done = [&] { return request_.answered || request_.serial == 0; };
    advance(LookUp::no);
    // The answer nearly always arrives within a round trip.
    while (!done() && may_wait_in_receive() && receive_waiting() == wire::IoStatus::ok &&
           MonoClock::now() < deadline) {
    }
    const WaitStatus status = run(deadline, false, done);
    if (request_.answered) return {};
    if (status == WaitStatus::timeout) {
      // A late answer must not be received into the caller's memory.
      Error error = unavailable_error("does not answer");
      on_disconnected(error);
      return error;
    }
    if (attempts_.last_error && !is_retryable(attempts_.last_error->code))
      return *attempts_.last_error;
  }
}

Result<net::Frame> StreamClient::ask(net::Frame request) {
  request_.target = nullptr;
  const auto queue = [&](std::uint64_t serial) {
    request.set_serial(serial);
    connection_.queue(request);
  };
  DSSM_TRY(exchange(queue));
  if (request_.answer.has_failure()) return wire::failure(request_.answer.failure());
  return std::move(request_.answer);
}

Result<ReadStatus> StreamClient::read(const wire::ReadRequest& request,
                                      std::span<std::byte> payload, SampleInfo& info) {
  if (payload.size() != stream_.type.payload_bytes) {
    return size_error("read", payload.size());
  }
  for (;;) {
    if (std::exchange(restart_.pending, false)) return ReadStatus::restarted;
    request_.target = payload.data();
    Result<void> done = exchange([&](std::uint64_t serial) {
      std::array<std::byte, wire::kMaxReadRequestBytes> bytes;
      connection_.queue(std::span(bytes).first(wire::encode_read_request(bytes, serial, request)));
    });
    request_.target = nullptr;
    if (!done) return std::move(done).error().context(what("read"));
    if (restart_.pending) continue;  // the answer was about the old ring
    if (request_.info) {
      if (request_.torn) continue;
      info = *request_.info;
      return ReadStatus::ok;
    }
    if (request_.answer.has_failure())
      return wire::failure(request_.answer.failure()).context(what("read"));
    const std::uint32_t status = request_.answer.no_sample().status();
    if (status < 1 || status > static_cast<std::uint32_t>(ReadStatus::lapped)) {
      return Error{Errc::protocol,
                   what("read") + ": dssmd's answer is neither a sample nor a status"};
    }
    return static_cast<ReadStatus>(status);
  }
}

// --- the subscription

void StreamClient::request_subscription() {
  net::Subscribe request;
  subscriber_->to_message(stream_.incarnation, request);
  channel_.subscribe(request);
}

Result<void> StreamClient::subscribe(const Subscription& what_from) {
  const MonoTime deadline = deadline_in(options_.request_timeout);
  DSSM_TRY(wait_until_up(deadline), what("subscribe to"));
  subscription_refused_.reset();
  subscriber_->begin(what_from);
  subscriber_->set_buffering(true);
  request_subscription();
  static_cast<void>(run(deadline, false, [&] { return is_up() || connection_.is_down(); }));
  if (!subscriber_->granted() && !subscription_refused_) {
    if (Result<void> up = wait_until_up(deadline); !up) {
      // A late answer must not begin a subscription that the program does not have any more.
      Error error = std::move(up).error();
      subscriber_->end();
      if (!connection_.is_down()) on_disconnected(error);
      return std::move(error).context(what("subscribe to"));
    }
  }
  if (subscription_refused_) return Error(*subscription_refused_).context(what("subscribe to"));
  return {};
}

Result<void> StreamClient::unsubscribe() {
  if (!subscriber_->active()) return {};
  subscriber_->end();
  forget_connection();
  connection_.end_pause();
  return wait_until_up(deadline_in(options_.request_timeout));
}

[[gnu::hot]] Result<ReadStatus> StreamClient::next(std::span<std::byte> payload, SampleInfo& info) {
  if (payload.size() != stream_.type.payload_bytes) {
    return size_error("read", payload.size());
  }
  if (!subscriber_->active()) {
    if (subscription_refused_) return Error(*subscription_refused_).context(what("subscribe to"));
    return Error{Errc::invalid_argument, what("read") + ": call subscribe() before read_next()"};
  }
  if (auto kept = subscriber_->pop_buffered(payload, info)) return *kept;
  subscriber_->set_buffering(false);
  subscriber_->set_target(payload.data());
  auto result = take_next(payload, info);
  if (subscriber_->is_filling_target())
    connection_.decoder().move_payload(subscriber_->detach_target());
  subscriber_->set_target(nullptr);
  return result;
}

[[gnu::hot]] Result<ReadStatus> StreamClient::take_next(std::span<std::byte> payload,
                                                        SampleInfo& info) {
  if (!sample_waits_) advance(LookUp::no);
  for (MonoTime stay_until = kNever;;) {
    // The rest of the sample is on its way: waiting for it here saves a copy of it.
    const bool waits = subscriber_->is_filling_target() && may_wait_in_receive();
    if (waits && stay_until == kNever) stay_until = deadline_in(kMaxStayWithSample);
    const bool received = waits ? receive_spinning() == wire::IoStatus::ok : receive();
    if (subscriber_->delivered(info)) return ReadStatus::ok;
    if (auto kept = subscriber_->pop_buffered(payload, info)) return *kept;
    if (!received || (waits && MonoClock::now() >= stay_until)) break;
  }
  if (is_up()) return ReadStatus::not_yet;
  Error error = attempts_.last_error ? *attempts_.last_error
                                     : Error{Errc::unavailable, "the connection is being set up"};
  if (error.code != Errc::not_found) error.code = Errc::unavailable;
  return std::move(error).context(what("read"));
}

[[gnu::hot]] WaitStatus StreamClient::wait(MonoTime deadline) {
  if (!subscriber_->active()) return WaitStatus::timeout;
  subscriber_->set_buffering(false);
  const std::uint64_t before = attempts_.failed;
  const auto done = [&] {
    return sample_waits_ || subscriber_->has_buffered() || has_failed_since(before);
  };
  // The next sample usually arrives soon; after that time poll(), which wakes up for data only.
  if (!done() && may_wait_in_receive() &&
      (deadline == kNever || deadline - MonoClock::now() >= wire::Transport::kReceiveWait)) {
    const wire::IoStatus status = receive_spinning();
    if (status == wire::IoStatus::interrupted) return WaitStatus::interrupted;
  }
  return run(deadline, true, done);
}

int StreamClient::ready_fd() noexcept {
  const bool has_one = sample_waits_ || subscriber_->has_buffered();
  return connection_.ready_fd(has_more_to_send(), has_one ? MonoTime::min() : next_step());
}

// --- publishing

void StreamClient::start_publishing() {
  channel_.publish(publishing_.publisher);
  // The owner has no samples of a new publisher, so there is no answer to wait for.
  publishing_.allowed = !publishing_.started;
  publishing_.started = true;
}

Result<void> StreamClient::post(std::span<const std::byte> payload, Time time,
                                Duration clock_error) {
  if (payload.size() > stream_.type.payload_bytes) {
    return size_error("write", payload.size());
  }
  if (!publishing_.started) {
    if (channel_.stream() == channel::ChannelClient::Stream::open) {
      start_publishing();
    } else {
      publishing_.started = true;
    }
  }
  outbox_->push(payload, time, clock_error);
  advance(LookUp::no);
  // Unsent bytes show that the other side is slow. While the connection is being set up, each call
  // takes the next step.
  if (++publishing_.posts_since_receive < kPostsPerReceive && is_up() && !has_more_to_send()) {
    return {};
  }
  publishing_.posts_since_receive = 0;
  subscriber_->set_buffering(true);
  while (receive()) {
  }
  return {};
}

Result<Tid> StreamClient::flush(MonoTime deadline) {
  if (outbox_->newest() < 0) return kNoTid;
  subscriber_->set_buffering(true);
  const std::uint64_t before = attempts_.failed;
  static_cast<void>(
      run(deadline, false, [&] { return outbox_->all_written() || has_failed_since(before); }));
  if (outbox_->all_written()) return outbox_->written_tid();
  if (has_failed_since(before)) return Error(*attempts_.last_error).context(what("write"));
  return unavailable_error("has not acknowledged all samples in time; they are kept and sent later")
      .context(what("write"));
}

PConnector::Counters StreamClient::counters() const noexcept {
  const wire::DecoderCounters counters = connection_.counters();
  return {counters.samples, counters.copied_payload_bytes + subscriber_->copied_bytes(),
          counters.direct_payload_bytes, attempts_.succeeded > 0 ? attempts_.succeeded - 1 : 0};
}

}  // namespace dssm::detail
