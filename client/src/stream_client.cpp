// SPDX-License-Identifier: Apache-2.0
#include "client/src/stream_client.hpp"

#include <fmt/format.h>
#include <poll.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>

#include "client/src/find_host.hpp"
#include "client/src/program_name.hpp"
#include "core/base/timespec.hpp"
#include "core/base/try.hpp"

namespace dssm::detail {
namespace {

using namespace std::chrono_literals;

// Between attempts to set up a connection.
constexpr Duration kFirstPause = 10ms;
constexpr Duration kMaxPause = 1s;
// How long next() receives a large sample that has begun to arrive in the caller's memory, before
// it moves what has arrived to a buffer: 10 MB at 1 GB/s. The last wait within that time may end
// Transport::kReceiveWait after it: the 20 ms that pconnector.hpp promises.
constexpr Duration kMaxStayWithSample = 10ms;
static_assert(kMaxStayWithSample + wire::Transport::kReceiveWait <= 20ms);

// post() receives acknowledgements once in so many calls.
constexpr unsigned kPostsPerReceive = 32;

constexpr Duration kCloseTimeout = 1s;  // how long ~StreamClient sends posted samples

Result<StreamInfo> stream_untrusted(const proto::Stream& message) {
  StreamId id = DSSM_TRY(wire::stream_id_untrusted(message.id()));
  TypeInfo type = DSSM_TRY(wire::type_untrusted(message.type()));
  if (message.depth() < kMinDepth || message.depth() > kMaxDepth) {
    return Error{Errc::protocol, fmt::format("a ring of {} slots", message.depth())};
  }
  StreamInfo info = wire::stream_info(message);
  info.id = std::move(id);
  info.type = std::move(type);
  return info;
}

}  // namespace

StreamClient::StreamClient(Goal goal, PConnectorOptions options)
    : goal_(std::move(goal)),
      options_(std::move(options)),
      owner_pid_(::getpid()),
      connection_(*this, options_.program.empty() ? default_program() : options_.program,
                  options_.request_timeout) {
  publishing_.publisher = wire::random_number();
}

Result<std::unique_ptr<StreamClient>> StreamClient::open(Goal goal, PConnectorOptions options) {
  std::unique_ptr<StreamClient> client(new StreamClient(std::move(goal), std::move(options)));
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
  return connection_.is_up() && setup_.opened && subscription_.serial == 0 &&
         publishing_.serial == 0;
}

Result<void> StreamClient::start_connecting(LookUp look_up) {
  if (look_up == LookUp::yes || host_.addresses.empty()) {
    host_.addresses = DSSM_TRY(find_host(*host_.name));
  }
  connection_.start(host_.addresses);
  return {};
}

void StreamClient::set_up() {
  setup_.sent = true;
  setup_.deadline = deadline_in(options_.request_timeout);
  net::Frame frame;
  setup_.serial = next_serial_++;
  frame.set_serial(setup_.serial);
  if (goal_.type) {
    wire::to_message(goal_.id, *frame.mutable_create()->mutable_id());
    wire::to_message(*goal_.type, *frame.mutable_create()->mutable_type());
    frame.mutable_create()->set_depth(goal_.history.depth);
    frame.mutable_create()->set_cycle_ns(to_ns(goal_.history.cycle));
  } else {
    wire::to_message(goal_.id, *frame.mutable_open()->mutable_id());
  }
  connection_.queue(frame);
  if (subscriber_ && subscriber_->active()) request_subscription();
  if (publishing_.started) start_publishing();
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
  sample_waits_ = publishing_.allowed = false;
  subscription_.serial = publishing_.serial = request_.serial = 0;
  if (subscriber_) subscriber_->on_down();
  if (outbox_) outbox_->on_down();
}

void StreamClient::on_disconnected(Error error) {
  if (!setup_.was_up) ++attempts_.failed;
  // After a useful connection the next attempt needs no pause.
  attempts_.pause =
      setup_.useful ? Duration(0) : std::clamp(2 * attempts_.pause, kFirstPause, kMaxPause);
  attempts_.next_at = MonoClock::now() + attempts_.pause;
  attempts_.last_error = std::move(error);
  forget_connection();
}

[[gnu::hot]] void StreamClient::advance(LookUp look_up) {
  if (connection_.is_down()) {
    if (MonoClock::now() < attempts_.next_at) return;
    if (Result<void> begun = start_connecting(look_up); !begun) {
      return on_disconnected(std::move(begun).error());
    }
  }
  if (!connection_.is_up()) {
    if (Result<void> done = connection_.advance(); !done)
      return on_disconnected(std::move(done).error());
    if (!connection_.is_up()) return;
  }
  if (!setup_.sent) set_up();
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
  // It may have been the greeting.
  if (*received == wire::IoStatus::ok && !setup_.sent) advance(LookUp::no);
  return *received;
}

MonoTime StreamClient::next_step() const noexcept {
  return connection_.is_down() ? attempts_.next_at
                               : std::min(connection_.next_step(), setup_.deadline);
}

// Works on the connection until done() or the deadline; at least once.
template <class Done>
WaitStatus StreamClient::run(MonoTime deadline, bool interruptible, Done done) {
  for (;;) {
    advance(LookUp::yes);
    if (done()) return WaitStatus::ready;
    if (sample_waits_) {
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
  return Error{Errc::invalid_argument, fmt::format("{}: its samples have {} bytes, not {}",
                                                   what(verb), stream_.type.payload_bytes, bytes)};
}

// --- protocol: what arrives

Result<void> StreamClient::on_opened(const net::Frame& frame) {
  setup_.serial = 0;
  if (frame.has_failure()) return wire::failure(frame.failure());
  if (!frame.has_opened()) {
    return Error{Errc::protocol, "dssmd's answer is not the opened stream"};
  }
  StreamInfo stream =
      DSSM_TRY(stream_untrusted(frame.opened().stream()), "dssmd's description of the stream");
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
  setup_.opened = true;
  return {};
}

Result<void> StreamClient::on_event(const net::Frame& frame) {
  if (frame.has_failure())
    return wire::failure(frame.failure()).context("dssmd closed the connection");
  if (frame.has_ended()) return Error{Errc::not_found, "the stream was removed"};
  if (!subscriber_) return {};
  if (frame.has_gap()) subscriber_->on_gap(frame.gap());
  if (frame.has_published()) {
    setup_.useful = true;
    return outbox_->acknowledge(frame.published().last(), frame.published().last_tid());
  }
  return {};
}

Result<void> StreamClient::on_frame(net::Frame& frame) {
  const std::uint64_t serial = frame.serial();
  if (serial == 0) return on_event(frame);
  Result<void> result;
  if (serial == setup_.serial) {
    result = on_opened(frame);
  } else if (serial == subscription_.serial) {
    subscription_.serial = 0;
    if (frame.has_failure()) {
      subscription_.refused = wire::failure(frame.failure());
      subscriber_->end();
    } else {
      result = subscriber_->on_subscribed(frame.subscribed());
    }
  } else if (serial == publishing_.serial) {
    publishing_.serial = 0;
    if (frame.has_failure()) return wire::failure(frame.failure()).context("publish");
    // A new publisher was allowed at once and has nothing to send again.
    if (!publishing_.allowed) {
      result = outbox_->restart(frame.publishing().last(), frame.publishing().last_tid());
    }
    publishing_.allowed = true;
  } else if (serial == request_.serial) {
    request_.answer = std::move(frame);
    request_.serial = 0;
    request_.answered = setup_.useful = true;
  }
  if (result) check_up();
  return result;
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
  setup_.useful = true;
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
    request_.serial = next_serial_++;
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

Result<ReadStatus> StreamClient::read(const ReadRequest& request, std::span<std::byte> payload,
                                      SampleInfo& info) {
  if (payload.size() != stream_.type.payload_bytes) {
    return size_error("read", payload.size());
  }
  for (;;) {
    if (std::exchange(restart_.pending, false)) return ReadStatus::restarted;
    request_.target = payload.data();
    Result<void> done = exchange([&](std::uint64_t serial) {
      std::array<std::byte, kMaxReadRequestBytes> bytes;
      connection_.queue(std::span(bytes).first(encode_read_request(bytes, serial, request)));
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
  net::Frame frame;
  subscription_.serial = next_serial_++;
  frame.set_serial(subscription_.serial);
  subscriber_->to_message(stream_.incarnation, *frame.mutable_subscribe());
  connection_.queue(frame);
}

Result<void> StreamClient::subscribe(const Subscription& what_from) {
  const MonoTime deadline = deadline_in(options_.request_timeout);
  DSSM_TRY(wait_until_up(deadline), what("subscribe to"));
  subscription_.refused.reset();
  subscriber_->begin(what_from);
  subscriber_->set_buffering(true);
  request_subscription();
  static_cast<void>(run(deadline, false, [&] { return is_up() || connection_.is_down(); }));
  if (!subscriber_->granted() && !subscription_.refused) {
    if (Result<void> up = wait_until_up(deadline); !up) {
      subscriber_->end();
      return std::move(up).error().context(what("subscribe to"));
    }
  }
  if (subscription_.refused) return Error(*subscription_.refused).context(what("subscribe to"));
  return {};
}

Result<void> StreamClient::unsubscribe() {
  if (!subscriber_->active()) return {};
  subscriber_->end();
  forget_connection();
  attempts_.next_at = MonoClock::now();
  return wait_until_up(deadline_in(options_.request_timeout));
}

[[gnu::hot]] Result<ReadStatus> StreamClient::next(std::span<std::byte> payload, SampleInfo& info) {
  if (payload.size() != stream_.type.payload_bytes) {
    return size_error("read", payload.size());
  }
  if (!subscriber_->active()) {
    if (subscription_.refused) return Error(*subscription_.refused).context(what("subscribe to"));
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
  if (!readiness_) {
    auto made = Readiness::make();
    if (!made) return connection_.fd();
    readiness_ = std::move(*made);
  }
  const bool has_one = sample_waits_ || subscriber_->has_buffered();
  readiness_->follow(connection_.fd(), connection_.events(has_more_to_send()),
                     has_one ? MonoTime::min() : next_step());
  return readiness_->fd();
}

// --- publishing

void StreamClient::start_publishing() {
  net::Frame frame;
  publishing_.serial = next_serial_++;
  frame.set_serial(publishing_.serial);
  frame.mutable_start_publishing()->set_publisher(publishing_.publisher);
  connection_.queue(frame);
  // The owner has no samples of a new publisher, so there is no answer to wait for.
  publishing_.allowed = !publishing_.started;
  publishing_.started = true;
}

Result<void> StreamClient::post(std::span<const std::byte> payload, Time time,
                                Duration clock_error) {
  if (payload.size() != stream_.type.payload_bytes) {
    return size_error("write", payload.size());
  }
  if (!publishing_.started) {
    if (is_up()) {
      start_publishing();
    } else {
      publishing_.started = true;
    }
  }
  outbox_->push(payload, time, clock_error);
  advance(LookUp::no);
  // Unsent bytes show that the other side is slow or disconnected.
  if (++publishing_.posts_since_receive < kPostsPerReceive && !has_more_to_send()) return {};
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
