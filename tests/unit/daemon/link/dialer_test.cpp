// SPDX-License-Identifier: Apache-2.0
//
// Keeping a connection up: against a server that greets, and against those that do not.
#include "daemon/link/dialer.hpp"

#include <gtest/gtest.h>
#include <netinet/in.h>

#include "core/wire/frame.hpp"
#include "tests/unit/daemon/scripted_host.hpp"

namespace dssm::daemon {
namespace {

// A server that says the same to everybody who connects, and nothing else.
class RawServer {
 public:
  RawServer(const EventLoop& loop, std::string words, bool hangs_up)
      : words_(std::move(words)), hangs_up_(hangs_up) {
    accepting_ = EventSource::readable(loop, listening_.get(), [this] { on_connection(); });
    accepting_.enable();
  }

  wire::SocketAddress address() const { return wire::local_address(listening_.get()).value(); }
  int connections() const { return connections_; }

 private:
  void on_connection() {
    ++connections_;
    UniqueFd socket(::accept4(listening_.get(), nullptr, nullptr, SOCK_CLOEXEC));
    EXPECT_EQ(::send(socket.get(), words_.data(), words_.size(), MSG_NOSIGNAL),
              static_cast<ssize_t>(words_.size()));
    if (hangs_up_) ::shutdown(socket.get(), SHUT_WR);
    sockets_.push_back(std::move(socket));
  }

  const std::string words_;
  const bool hangs_up_;
  int connections_ = 0;
  UniqueFd listening_ = listen_on_loopback();
  std::vector<UniqueFd> sockets_;
  EventSource accepting_;
};

// A full queue of connections: the kernel leaves further ones without any answer.
class SilentServer {
 public:
  SilentServer() {
    sockaddr_in any{};
    any.sin_family = AF_INET;
    any.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
    EXPECT_EQ(::bind(full_.get(), reinterpret_cast<const sockaddr*>(&any), sizeof any), 0);
    EXPECT_EQ(::listen(full_.get(), 0), 0);
    EXPECT_EQ(::connect(filler_.get(), address().get(), address().length), 0);
  }
  wire::SocketAddress address() const { return wire::local_address(full_.get()).value(); }
  // From now on the kernel answers new connections.
  void make_room() const { UniqueFd(::accept4(full_.get(), nullptr, nullptr, SOCK_CLOEXEC)); }

 private:
  UniqueFd full_{::socket(AF_INET, SOCK_STREAM | SOCK_CLOEXEC, 0)};
  UniqueFd filler_{::socket(AF_INET, SOCK_STREAM | SOCK_CLOEXEC, 0)};
};

// A port that nobody listens at: taken and given back.
wire::SocketAddress closed_port(const EventLoop& loop) {
  return RawServer(loop, "", false).address();
}

class DialerTest : public testing::Test, protected Dialer::Observer {
 protected:
  EventLoop loop = EventLoop::open(TimerQueue::Time::simulated).value();
  std::vector<wire::SocketAddress> answers;  // of the resolver, for names
  Resolver resolver{loop, [this](const wire::Address&) -> Result<std::vector<wire::SocketAddress>> {
                      return answers;
                    }};
  std::unique_ptr<Dialer> dialer;
  std::optional<wire::Greeting> them;
  std::vector<Error> downs;
  std::vector<net::Frame> frames;
  bool up = false;

  void dial(const wire::Address& address) {
    dialer =
        std::make_unique<Dialer>(loop, resolver, Dialer::Options{{address}, greeting_of("pc1")},
                                 static_cast<Dialer::Observer&>(*this));
  }
  void dial_in_turn(const std::vector<wire::SocketAddress>& at, Dialer::Options options = {}) {
    for (const wire::SocketAddress& address : at) {
      options.addresses.push_back(wire::Address::parse(address.str()).value());
    }
    options.self = greeting_of("pc1");
    dialer = std::make_unique<Dialer>(loop, resolver, std::move(options),
                                      static_cast<Dialer::Observer&>(*this));
  }
  void dial(const wire::SocketAddress& address) {
    dial(wire::Address::parse(address.str()).value());
  }
  void wait(const std::function<bool()>& done) { run_until(loop, done); }
  // Whether it is done before `time` is over.
  bool is_done_within(Duration time, const std::function<bool()>& done) {
    bool is_over = false;
    EventSource timer = EventSource::timer(loop, [&] { is_over = true; });
    timer.enable_in(time);
    wait([&] { return done() || is_over; });
    return done();
  }
  void wait_for(Duration time) {
    is_done_within(time, [] { return false; });
  }
  const Error& wait_for_down() {
    wait([this] { return !downs.empty(); });
    return downs.front();
  }

  void on_up(FrameConnection& link, const wire::Greeting& greeting) override {
    EXPECT_EQ(&link, dialer->connection());
    EXPECT_FALSE(up);
    up = true;
    them = greeting;
  }
  Result<void> on_frame(net::Frame& frame) override {
    frames.push_back(std::move(frame));
    return {};
  }
  void on_down(const Error& error) override {
    EXPECT_EQ(dialer->connection(), nullptr);
    up = false;
    downs.push_back(error);
  }
};

TEST_F(DialerTest, GreetsAndHandsOverTheLink) {
  ScriptedHost owner(loop);
  dial(owner.address());
  EXPECT_EQ(dialer->connection(), nullptr);
  EXPECT_EQ(dialer->address(), owner.address().str());
  wait([this] { return up; });
  EXPECT_EQ(them->host, "pc2");
  EXPECT_EQ(them->host_id, owner.host().greeting.host_id);
  EXPECT_FALSE(dialer->is_insecure());
  dialer->connection()->send(with_serial(5, ping_frame()));
  EXPECT_EQ(owner.receive().serial(), 5u);
  net::Frame pong;
  pong.set_serial(5);
  pong.mutable_pong();
  owner.send(pong);
  wait([this] { return !frames.empty(); });
  EXPECT_TRUE(frames.front().has_pong());
  EXPECT_TRUE(downs.empty());
}

TEST_F(DialerTest, TriesTheAddressesOfANameInTurn) {
  ScriptedHost owner(loop);
  const wire::SocketAddress good = wire::resolve_number(owner.address()).at(0);
  answers = {closed_port(loop), closed_port(loop), good};
  dial({"pc2", 1});
  wait([this] { return up; });
  EXPECT_EQ(dialer->address(), good.str());
  EXPECT_TRUE(downs.empty()) << "one round of attempts, and it was good";
}

TEST_F(DialerTest, TriesTheAddressesThatItIsGivenInTurn) {
  ScriptedHost owner(loop);
  const wire::SocketAddress good = wire::resolve_number(owner.address()).at(0);
  dial_in_turn({closed_port(loop), closed_port(loop), good});
  wait([this] { return up; });
  EXPECT_EQ(dialer->address(), good.str());
  EXPECT_TRUE(downs.empty());
}

TEST_F(DialerTest, ContinuesAfterAnAddressThatDoesNotWork) {
  RawServer talker(loop, "220 smtp ready\r\n", false);
  ScriptedHost owner(loop);
  const wire::SocketAddress good = wire::resolve_number(owner.address()).at(0);
  dial_in_turn({talker.address(), closed_port(loop), good});
  wait([this] { return up; });
  EXPECT_EQ(downs.size(), 1u);
  EXPECT_EQ(talker.connections(), 1);
  dialer->restart({Errc::unavailable, "silent"});
  wait([&] { return talker.connections() == 2; });  // the one behind the last one
  wait([&] { return up && downs.size() >= 3; });
}

TEST_F(DialerTest, LetsItsAddressesShareTheTimeOfARound) {
  const SilentServer silent;
  const wire::SocketAddress dead = silent.address();
  ScriptedHost owner(loop);
  Dialer::Options options;
  options.round_time = std::chrono::milliseconds(40);
  dial_in_turn({dead, dead, dead, wire::resolve_number(owner.address()).at(0)}, options);
  // One address would take so long otherwise.
  EXPECT_TRUE(is_done_within(channel::ConnectPlan::kConnectTimeout, [this] { return up; }));
  EXPECT_TRUE(downs.empty());
}

TEST_F(DialerTest, LeavesAnAddressThatDoesNotAnswerForNewOnesAtOnce) {
  const SilentServer silent;
  ScriptedHost owner(loop);
  dial_in_turn({silent.address()});
  event_base_loop(loop.base(), EVLOOP_ONCE);  // it begins to connect
  bool timed_out = false;
  EventSource timer = EventSource::timer(loop, [&] { timed_out = true; });
  timer.enable_in(channel::ConnectPlan::kConnectTimeout);  // what it would wait else
  dialer->set_addresses({owner.address()});
  wait([&] { return up || timed_out; });
  EXPECT_TRUE(up);
  EXPECT_TRUE(downs.empty());
  dialer->set_addresses({wire::Address::parse(silent.address().str()).value()});
  event_base_loop(loop.base(), EVLOOP_ONCE | EVLOOP_NONBLOCK);
  EXPECT_TRUE(up) << "what is up stays";
}

TEST_F(DialerTest, LeavesAnAttemptThatWaitsForAnAnswerWhenTheNetworkChanged) {
  const SilentServer silent;
  ScriptedHost owner(loop);
  answers = {silent.address()};
  dial({"pc2", 1});
  wait([this] { return dialer->reached() == Dialer::Phase::connect; });
  answers = wire::resolve_number(owner.address());
  dialer->retry_now(Dialer::kMinRound);  // it has just begun
  EXPECT_FALSE(is_done_within(Dialer::kMinRound, [this] { return up; }));
  dialer->retry_now(Dialer::kMinRound);
  // No timer runs here, so nothing times out. The name is resolved by a thread, in real time.
  while (!up) event_base_loop(loop.base(), EVLOOP_ONCE);
  EXPECT_TRUE(downs.empty());
}

TEST_F(DialerTest, TriesNoMoreAfterAStopUntilItIsAsked) {
  ScriptedHost owner(loop);
  dial(owner.address());
  wait([this] { return up; });
  const auto is_up_soon = [this] {
    return is_done_within(10 * channel::ConnectPlan::kFirstPause, [this] { return up; });
  };
  dialer->stop({Errc::unavailable, "its host is down"});
  EXPECT_EQ(wait_for_down().message, "its host is down");
  EXPECT_FALSE(is_up_soon()) << "it was up";
  dialer->retry_now();
  wait([this] { return up; });
  dialer->restart({Errc::unavailable, "again"});
  wait([this] { return downs.size() == 2; });
  dialer->stop({Errc::unavailable, "it pauses already"});
  EXPECT_FALSE(is_up_soon()) << "it paused";
  EXPECT_EQ(downs.size(), 2u);
}

TEST_F(DialerTest, TriesNoMoreAfterAStopWhileItGreets) {
  RawServer server(loop, "", false);
  dial(server.address());
  wait([this] { return dialer->reached() == Dialer::Phase::greet; });
  dialer->stop({Errc::unavailable, "its host is down"});
  EXPECT_EQ(wait_for_down().message, "its host is down");
  wait_for(2 * wire::kHelloTimeout);
  EXPECT_EQ(server.connections(), 1);
}

TEST_F(DialerTest, TriesSoonAgainAfterAUsefulConnectionIfItIsToRetryOften) {
  for (const bool retries_often : {true, false}) {
    const SilentServer silent;
    ScriptedHost owner(loop);
    answers = {wire::resolve_number(owner.address()).at(0)};
    downs.clear();
    Dialer::Options options;
    options.addresses = {{"pc2", 1}};
    options.retries_often = retries_often;
    dial_in_turn({}, std::move(options));
    wait([this] { return up; });
    wait_for(channel::ConnectPlan::kUsefulTime);
    answers = {silent.address()};
    owner.cut();
    wait([this] { return !up; });
    const MonoTime lost = loop.now();
    wait([this] { return downs.size() == 2; });
    const Duration tried = loop.now() - lost - channel::ConnectPlan::kFirstPause;
    EXPECT_EQ(tried < channel::ConnectPlan::kConnectTimeout, retries_often);
    // The next round begins at once, and does not wait until the kernel repeats a lost packet.
    const MonoTime began = MonoClock::now();
    wait([this] { return dialer->reached() == Dialer::Phase::connect; });
    wait_for(channel::ConnectPlan::kRecentTimeout / 4);
    silent.make_room();
    const bool is_found = is_done_within(2 * channel::ConnectPlan::kRepeat, [this] {
      return dialer->reached() == Dialer::Phase::greet;
    });
    // The kernel counts real time, and the machine may have stopped this test meanwhile.
    const bool was_repeated = MonoClock::now() - began > channel::ConnectPlan::kFirstRepeat / 2;
    EXPECT_TRUE(is_found == retries_often || (is_found && was_repeated));
    EXPECT_EQ(downs.size(), 2u) << "in the same attempt";
  }
}

TEST_F(DialerTest, ReportsWhyNoAddressOfANameWorked) {
  answers = {closed_port(loop), closed_port(loop)};
  dial({"pc2", 1});
  const Error& error = wait_for_down();
  EXPECT_NE(error.message.find(answers[1].str()), std::string::npos) << error.message;
  EXPECT_NE(error.message.find("refused"), std::string::npos) << error.message;
}

TEST_F(DialerTest, ReportsWhyANameCouldNotBeResolvedAndRetries) {
  dial({"pc2", 1});  // no address
  EXPECT_EQ(wait_for_down().code, Errc::not_found);
  ScriptedHost owner(loop);
  wait([this] { return downs.size() == 2; });
  answers = {wire::resolve_number(owner.address()).at(0)};
  wait([this] { return up; });
}

TEST_F(DialerTest, ReconnectsWhenTheConnectionBroke) {
  ScriptedHost owner(loop);
  dial(owner.address());
  for (int round = 0; round < 3; ++round) {
    wait([this] { return up; });
    owner.cut();
    wait([this] { return !up; });
  }
  EXPECT_EQ(downs.size(), 3u);
  EXPECT_NE(downs.front().message.find("dssmd of host 'pc2'"), std::string::npos)
      << downs.front().message;
}

TEST_F(DialerTest, FindsAServerThatStartsLater) {
  const wire::SocketAddress port = closed_port(loop);
  dial(port);
  wait([this] { return downs.size() >= 2; });
  ScriptedHost owner(loop);
  dialer->set_addresses({owner.address()});
  dialer->retry_now();
  wait([this] { return up; });
}

TEST_F(DialerTest, QuotesAServerThatRefusesIt) {
  const net::Frame failure = failure_frame(Errc::limit_exceeded, "too many connections");
  RawServer server(loop, wire::encode_frame(failure), true);
  dial(server.address());
  const Error& error = wait_for_down();
  EXPECT_EQ(error.code, Errc::limit_exceeded);
  EXPECT_EQ(error.message,
            "refused by dssmd at '" + server.address().str() + "': too many connections");
}

TEST_F(DialerTest, QuotesTheFinalFailureOfAServerThatWasUp) {
  ScriptedHost owner(loop);
  dial(owner.address());
  wait([this] { return up; });
  owner.send(failure_frame(Errc::no_permission, "no more"));
  const Error& error = wait_for_down();
  EXPECT_EQ(error.code, Errc::no_permission);
  EXPECT_EQ(error.message.find("refused by dssmd of host 'pc2'"), 0u) << error.message;
  EXPECT_NE(error.message.find("no more"), std::string::npos);
}

TEST_F(DialerTest, RefusesAServerOfAnotherVersionNamingIt) {
  RawServer server(loop, wire::encode_frame(hello_frame(greeting_of("pc9"), 77)), false);
  dial(server.address());
  const Error& error = wait_for_down();
  EXPECT_EQ(error.code, Errc::protocol);
  EXPECT_NE(error.message.find("77"), std::string::npos) << error.message;
  EXPECT_NE(error.message.find(server.address().str()), std::string::npos) << error.message;
}

TEST_F(DialerTest, GivesUpAServerThatSendsAnotherFrameThanHello) {
  net::Frame frame;
  frame.mutable_done();
  RawServer server(loop, wire::encode_frame(frame), false);
  dial(server.address());
  EXPECT_EQ(wait_for_down().code, Errc::protocol);
}

TEST_F(DialerTest, GivesUpAServerThatSendsGarbage) {
  RawServer server(loop, "SSH-2.0-OpenSSH_9.2\r\n" + std::string(100, '\xff'), false);
  dial(server.address());
  EXPECT_EQ(wait_for_down().code, Errc::protocol);
}

TEST_F(DialerTest, GivesUpAServerThatClosesWithoutAFrame) {
  RawServer server(loop, "", true);
  dial(server.address());
  const Error& error = wait_for_down();
  EXPECT_NE(error.message.find(server.address().str()), std::string::npos) << error.message;
}

TEST_F(DialerTest, GivesUpAServerThatDoesNotGreetInTime) {
  RawServer server(loop, "", false);
  dial(server.address());
  const Error& error = wait_for_down();
  EXPECT_EQ(error.code, Errc::unavailable);
  EXPECT_EQ(dialer->reached(), Dialer::Phase::greet);
  EXPECT_NE(error.message.find("does not greet"), std::string::npos) << error.message;
}

TEST_F(DialerTest, GivesUpAServerThatGreetsTwice) {
  ScriptedHost owner(loop);
  dial(owner.address());
  wait([this] { return up; });
  owner.send(hello_frame(greeting_of("pc2")));
  EXPECT_EQ(wait_for_down().code, Errc::protocol);
}

TEST_F(DialerTest, RestartsWhatIsUpForTheReasonThatIsGiven) {
  ScriptedHost owner(loop);
  dial(owner.address());
  wait([this] { return up; });
  dialer->restart({Errc::unavailable, "silent"});
  EXPECT_TRUE(downs.empty()) << "from the loop";
  EXPECT_EQ(wait_for_down().message, "silent");
  wait([this] { return up; });
  EXPECT_EQ(downs.size(), 1u);
}

TEST_F(DialerTest, RestartsAnAttemptThatIsUnderWay) {
  ScriptedHost owner(loop);
  dial({"pc2", 1});
  answers = {wire::resolve_number(owner.address()).at(0)};
  event_base_loop(loop.base(), EVLOOP_ONCE | EVLOOP_NONBLOCK);  // it looks the name up
  dialer->restart({Errc::unavailable, "moved"});
  EXPECT_EQ(wait_for_down().message, "moved");
  dialer->restart({Errc::unavailable, "not told: it pauses"});
  wait([this] { return up; });
  EXPECT_EQ(downs.size(), 1u);
}

TEST_F(DialerTest, PausesLongerAfterEachFailureAndNotWhenHurried) {
  RawServer server(loop, "", true);
  dial(server.address());
  const MonoTime begin = loop.now();
  wait([this] { return downs.size() == 5; });
  const Duration pauses = channel::ConnectPlan::kFirstPause * (1 + 2 + 4 + 8);
  EXPECT_GE(loop.now() - begin, pauses);
  const int before = server.connections();
  const auto run_without_timers = [&] {
    for (int i = 0; i < 1000; ++i) event_base_loop(loop.base(), EVLOOP_ONCE | EVLOOP_NONBLOCK);
  };
  run_without_timers();
  EXPECT_EQ(server.connections(), before) << "it pauses";
  dialer->retry_now();
  run_without_timers();
  EXPECT_EQ(server.connections(), before + 1);
}

TEST_F(DialerTest, RefusesSamplesOnAConnectionThatCarriesNone) {
  ScriptedHost owner(loop);
  dial(owner.address());
  wait([this] { return up; });
  owner.send_sample({0, Time(), Duration()}, Bytes(8));
  EXPECT_EQ(wait_for_down().code, Errc::protocol);
}

TEST_F(DialerTest, MayBeDestroyedAtAnyStep) {
  ScriptedHost owner(loop);
  const wire::Address address = owner.address();
  for (int rounds = 0; rounds < 12; ++rounds) {
    dial(address);
    for (int i = 0; i < rounds; ++i) event_base_loop(loop.base(), EVLOOP_ONCE | EVLOOP_NONBLOCK);
    up = false;
    dialer.reset();
  }
  dial(address);
  wait([this] { return up; });
}

}  // namespace
}  // namespace dssm::daemon
