// SPDX-License-Identifier: Apache-2.0
//
// One round of attempts: look the address up, try what was found in turn, greet. A round that
// fails, and a connection that ends, lead to a pause and to the next round. Everything happens in
// callbacks of the loop, and each step is left only by the timer or by the event it waits for.
#include "daemon/link/dialer.hpp"

#include <algorithm>
#include <optional>
#include <utility>
#include <vector>

#include "core/wire/tcp.hpp"

namespace dssm::daemon {

struct Dialer::State {
  enum class Step {
    look_up,  // until the resolver answers
    connect,  // until the socket is connected, or the timer
    greet,    // until their Hello came, or the timer
    up,       // until the link closes
    give_up,  // restart() was called: until the timer, at once
    pause,    // until the timer
  };

  State(const EventLoop& event_loop, Resolver& with, Options given, Observer& for_user,
        FrameConnection::Observer& of_link)
      : loop(event_loop),
        resolver(with),
        options(std::move(given)),
        observer(for_user),
        link_user(of_link),
        timer(EventSource::timer(loop, [this] { on_timer(); })) {
    timer.enable_in(Duration::zero());
  }

  void begin_round();
  void reopen();
  void begin_with(std::vector<wire::SocketAddress> found);
  void try_next_address();
  void on_connected();
  void on_timer();
  Result<void> on_frame(net::Frame& frame);
  Result<void> greet_untrusted(const net::Frame& frame);
  void fail(const Error& why);
  std::string who() const;

  const EventLoop& loop;
  Resolver& resolver;
  Options options;
  Observer& observer;
  FrameConnection::Observer& link_user;

  Step step = Step::pause;
  Phase reached = Phase::look_up;  // in this round, or in the last one
  Duration pause = kFirstPause;    // the next one
  MonoTime up_since{};
  Resolver::Ticket looking_up;
  std::vector<wire::SocketAddress> addresses;
  std::size_t current = 0;    // of `addresses`: the one that is tried or connected to
  std::optional<Error> last;  // why the address before it did not work
  UniqueFd socket;            // while it connects
  std::unique_ptr<FrameConnection>
      link;  // until the next round: it must not end in its own callbacks
  std::optional<wire::Greeting> them;
  std::optional<Error> reason;  // why the link is about to close, when we know better than it does
  bool given_up = false;        // by restart(), while it was up
  std::string last_choice;      // of addresses; empty: any
  EventSource connected, timer;
};

// Leaves an attempt to connect for a round of its own. From the timer: it may be in the attempt's
// own callback that somebody has learned of better addresses.
void Dialer::State::reopen() {
  connected.disable();
  socket.reset();
  step = Step::pause;
  timer.enable_in(Duration::zero());
}

// Who is at the other end, as far as known.
std::string Dialer::State::who() const {
  const std::string address = "'" + addresses[current].str() + "'";
  return them ? them->str() + " (" + address + ")" : "dssmd at " + address;
}

void Dialer::State::begin_round() {
  link.reset();
  them.reset();
  reason.reset();
  last.reset();
  step = Step::look_up;
  reached = Phase::look_up;
  std::vector<wire::SocketAddress> numbers;
  for (const wire::Address& address : options.addresses) {
    const std::vector<wire::SocketAddress> found = wire::resolve_number(address);
    numbers.insert(numbers.end(), found.begin(), found.end());
  }
  if (!numbers.empty()) return begin_with(std::move(numbers));
  looking_up = resolver.resolve(options.addresses.front(),
                                [this](Result<std::vector<wire::SocketAddress>> found) {
                                  if (!found) return fail(found.error());
                                  begin_with(*std::move(found));
                                });
}

void Dialer::State::begin_with(std::vector<wire::SocketAddress> found) {
  addresses = std::move(found);
  const auto last_one = std::find_if(
      addresses.begin(), addresses.end(),
      [this](const wire::SocketAddress& address) { return address.str() == last_choice; });
  if (last_one != addresses.end()) std::rotate(addresses.begin(), last_one + 1, addresses.end());
  current = 0;
  try_next_address();
}

// Tries addresses[current] and, while they fail at once, those behind it.
void Dialer::State::try_next_address() {
  reached = Phase::connect;
  for (; current < addresses.size(); ++current) {
    Result<UniqueFd> started = wire::start_connect(addresses[current]);
    if (!started) {
      last = std::move(started).error();
      continue;
    }
    step = Step::connect;
    socket = *std::move(started);
    connected = EventSource::writable(loop, socket.get(), [this] { on_connected(); });
    connected.enable();
    const auto share = options.round_time / static_cast<std::int64_t>(addresses.size());
    return timer.enable_in(std::min(kConnectTimeout, share));
  }
  fail(*last);
}

void Dialer::State::on_connected() {
  connected.disable();
  if (Result<void> done = wire::finish_connect(socket.get(), addresses[current]); !done) {
    last = std::move(done).error();
    socket.reset();
    // From the timer, because `connected` must not be replaced while its callback runs.
    return timer.enable_in(Duration::zero());
  }
  wire::set_channel_options(socket.get());
  step = Step::greet;
  reached = Phase::greet;
  timer.enable_in(wire::kHelloTimeout);
  link = std::make_unique<FrameConnection>(
      loop, wire::make_transport(std::move(socket), wire::TransportEnd::connected), link_user,
      options.max_queued_bytes);
  net::Frame hello;
  wire::to_message(options.self, *hello.mutable_hello());
  link->send(hello);
}

void Dialer::State::on_timer() {
  switch (step) {
    case Step::pause:
      return begin_round();
    case Step::give_up:
      return fail(*std::exchange(reason, {}));
    case Step::connect:
      if (socket) {
        connected.disable();
        socket.reset();
        last =
            Error{Errc::unavailable, "connect to '" + addresses[current].str() +
                                         "': no answer; is that PC on, and is there a way to it?"};
      }
      ++current;
      return try_next_address();
    case Step::greet:
      reason = Error{Errc::unavailable, who() + " does not greet; is it a dssmd?"};
      return link->close_with(*reason);
    case Step::look_up:
    case Step::up:
      return;
  }
}

Result<void> Dialer::State::on_frame(net::Frame& frame) {
  if (frame.serial() == 0 && frame.has_failure()) {
    reason = wire::failure(frame.failure()).context("refused by " + who());
    return *reason;
  }
  if (step == Step::greet) return greet_untrusted(frame);
  if (frame.has_hello()) return Error{Errc::protocol, "it greets twice"};
  return observer.on_frame(frame);
}

Result<void> Dialer::State::greet_untrusted(const net::Frame& frame) {
  if (!frame.has_hello()) {
    reason = Error{Errc::protocol, who() + " does not begin with Hello; is it a dssmd?"};
    return *reason;
  }
  Result<wire::Greeting> greeting = wire::greeting_untrusted(frame.hello(), who());
  if (!greeting) {
    reason = std::move(greeting).error();
    return *reason;
  }
  them = *std::move(greeting);
  timer.disable();
  step = Step::up;
  reached = Phase::up;
  up_since = loop.now();
  observer.on_up(*link, *them);
  return {};
}

void Dialer::State::fail(const Error& why) {
  // A server that greets and then refuses is not asked 20 times a second.
  if (step == Step::up && loop.now() - up_since >= kLongestPause) pause = kFirstPause;
  const bool of_no_use = std::exchange(given_up, false) || step == Step::greet;
  last_choice = of_no_use ? addresses[current].str() : std::string();
  step = Step::pause;
  timer.enable_in(pause);
  pause = std::min(2 * pause, options.longest_pause);
  observer.on_down(why);
}

Dialer::Dialer(const EventLoop& loop, Resolver& resolver, Options options, Observer& observer)
    : state_(new State(loop, resolver, std::move(options), observer, *this)) {}

Dialer::~Dialer() = default;

void Dialer::retry_now() {
  state_->pause = kFirstPause;
  if (state_->step == State::Step::pause) state_->timer.enable_in(Duration::zero());
}

void Dialer::restart(const Error& why) {
  State& state = *state_;
  switch (state.step) {
    case State::Step::pause:
    case State::Step::give_up:
      return;
    case State::Step::greet:
    case State::Step::up:
      if (!state.link->is_open()) return;  // on_closed() is on its way
      state.reason = why;
      state.given_up = true;
      return state.link->close_with(why);
    case State::Step::look_up:
    case State::Step::connect:
      state.looking_up.reset();
      state.connected.disable();
      state.socket.reset();
      state.reason = why;
      state.step = State::Step::give_up;
      return state.timer.enable_in(Duration::zero());
  }
}

void Dialer::set_addresses(std::vector<wire::Address> addresses) {
  State& state = *state_;
  if (addresses == state.options.addresses) return;
  state.options.addresses = std::move(addresses);
  if (state.step == State::Step::connect) state.reopen();
}

FrameConnection* Dialer::link() noexcept {
  return state_->step == State::Step::up ? state_->link.get() : nullptr;
}

Dialer::Phase Dialer::reached() const noexcept { return state_->reached; }

std::string Dialer::address() const {
  const State& state = *state_;
  return state.link && state.step != State::Step::pause ? state.addresses[state.current].str()
                                                        : state.options.addresses.front().str();
}

bool Dialer::crosses_network() const noexcept {
  const State& state = *state_;
  return state.step == State::Step::up && !state.addresses[state.current].is_loopback();
}

Result<void> Dialer::on_frame(net::Frame& frame) { return state_->on_frame(frame); }

void Dialer::on_output_empty() {
  if (state_->step == State::Step::up) state_->observer.on_output_empty();
}

void Dialer::on_closed(const Error& why) {
  State& state = *state_;
  state.fail(state.reason ? *std::exchange(state.reason, {}) : Error(why).context(state.who()));
}

}  // namespace dssm::daemon
