// SPDX-License-Identifier: Apache-2.0
//
// Encrypted connections between a ChannelServer and the Dialers of other hosts, on loopback: who is
// let in, who is not, and what both sides say about it.
#include <gtest/gtest.h>
#include <poll.h>
#include <sys/socket.h>

#include <algorithm>
#include <filesystem>
#include <list>
#include <vector>

#include "core/wire/tls.hpp"
#include "daemon/link/dialer.hpp"
#include "daemon/serve/channel_server.hpp"
#include "tests/support/authority.hpp"
#include "tests/support/daemon_process.hpp"
#include "tests/support/log_recorder.hpp"
#include "tests/unit/daemon/scripted_host.hpp"

namespace dssm::daemon {
namespace {

class SecureServer : public testing::Test {
 protected:
  // A host that dials the server.
  struct Guest final : Dialer::Observer {
    Guest(SecureServer& rig, wire::Greeting self)
        : dialer(rig.loop, rig.resolver,
                 {{wire::Address::parse(rig.network.addresses().front()).value()},
                  std::move(self),
                  &rig.dials},
                 *this) {}
    void on_up(FrameConnection&, const wire::Greeting& greeting) override { them = greeting; }
    Result<void> on_frame(net::Frame& frame) override {
      frames.push_back(frame);
      return {};
    }
    void on_down(const Error& error) override {
      them.reset();
      downs.push_back(error.message);
    }
    std::optional<wire::Greeting> them;
    std::vector<net::Frame> frames;
    std::vector<std::string> downs;
    Dialer dialer;
  };

  ~SecureServer() override { std::filesystem::remove_all(dir); }

  std::string folder(const std::string& name) const { return dir / name; }
  std::shared_ptr<wire::OwnCredentials> load(const std::string& name) {
    return std::make_shared<wire::OwnCredentials>(
        wire::OwnCredentials{wire::TlsCredentials::load(folder(name)).value()});
  }
  std::shared_ptr<wire::OwnCredentials> issue(const Authority::Subject& subject) {
    serials[subject.name] = authority.issue(subject, folder(subject.name));
    return load(subject.name);
  }
  static wire::Greeting with(std::shared_ptr<const wire::OwnCredentials> credentials,
                             const std::string& host, const std::string& program = "dssmd") {
    wire::Greeting greeting = greeting_of(host, program);
    greeting.credentials = std::move(credentials);
    return greeting;
  }
  Guest& dial(wire::Greeting self) { return guests.emplace_back(*this, std::move(self)); }
  void wait_until_up(Guest& guest) {
    run_until(loop, [&] { return guest.them || !guest.downs.empty(); });
    ASSERT_TRUE(guest.them) << guest.downs.front();
  }
  const std::string& wait_for_down(Guest& guest) {
    run_until(loop, [&] { return !guest.downs.empty(); });
    return guest.downs.front();
  }
  void expect_logged(const std::string& words) {
    run_until(loop, [&] { return logger.contains(words); });
  }

  const std::filesystem::path dir = test::make_temp_dir();
  Authority authority;
  std::map<std::string, long> serials;
  EventLoop loop = EventLoop::open(TimerQueue::Time::simulated).value();
  Resolver resolver{loop, [](const wire::Address&) -> Result<std::vector<wire::SocketAddress>> {
                      return std::vector<wire::SocketAddress>{};
                    }};
  Registry registry{"pc1", kLimits};
  OpenTable opens{{100, 100}};
  const Rights rights{};
  LogRecorder logger;
  std::shared_ptr<wire::OwnCredentials> own = issue(Authority::host("pc1"));
  std::vector<std::string> heartbeats;  // of which hosts
  ChannelServer server{
      {loop, registry, opens, rights, logger, nullptr,
       [this](const wire::Greeting& host, const auto&) { heartbeats.push_back(host.host); }},
      with(own, "pc1"),
      {8, 4, 32U << 20}};
  NetworkListener::Inherited none;
  NetworkListener network =
      NetworkListener::open(
          std::vector<wire::Address>{wire::Address::parse("127.0.0.1:0", 0, true).value()}, none,
          logger)
          .value();
  HandshakeBudget dials{loop};  // of the guests
  std::list<Guest> guests;

  void SetUp() override { server.serve(network); }
};

TEST_F(SecureServer, ServesAHostOfTheSameAuthority) {
  registry.create({"odometry", 0, ""}, odometry_type(), kHistory, 1).value();
  Guest& guest = dial(with(issue(Authority::host("pc2")), "pc2"));
  wait_until_up(guest);
  EXPECT_EQ(guest.them->host, "pc1");
  EXPECT_EQ(guest.dialer.connection()->peer()->str(), "host 'pc1'");
  EXPECT_FALSE(guest.dialer.is_insecure());
  net::Frame list;
  list.set_serial(1);
  list.mutable_list();
  guest.dialer.connection()->send(list);
  run_until(loop, [&] { return !guest.frames.empty(); });
  EXPECT_EQ(guest.frames[0].stream_list().streams_size(), 1);
}

TEST_F(SecureServer, BelievesTheCertificateAndNotTheGreeting) {
  EXPECT_NE(wait_for_down(dial(with(issue(Authority::host("pc2")), "pc3")))
                .find("dssmd of host 'pc3' greets with the certificate of host 'pc2'"),
            std::string::npos)
      << guests.back().downs.front();
  expect_logged("dssmd of host 'pc3' greets with the certificate of host 'pc2'");
  EXPECT_NE(wait_for_down(dial(with(issue(Authority::program("viewer")), "pc3")))
                .find("greets with the certificate of program 'viewer'"),
            std::string::npos);
}

TEST_F(SecureServer, IsNotBelievedUnderAnotherName) {
  ChannelServer liar({loop, registry, opens, rights, logger}, with(own, "pc9"), {8, 4, 32U << 20});
  network = NetworkListener::open(
                std::vector<wire::Address>{wire::Address::parse("127.0.0.1:0", 0, true).value()},
                none, logger)
                .value();
  liar.serve(network);
  EXPECT_NE(wait_for_down(dial(with(issue(Authority::host("pc2")), "pc2")))
                .find("'pc9' greets with the certificate of host 'pc1'"),
            std::string::npos)
      << guests.back().downs.front();
  guests.clear();
}

TEST_F(SecureServer, SaysWhyACertificateIsNotAccepted) {
  Authority::Subject old = Authority::host("pc2");
  old.valid_from = Authority::Hours(-9), old.valid_until = Authority::Hours(-1);
  EXPECT_NE(wait_for_down(dial(with(issue(old), "pc2"))).find("certificate expired"),
            std::string::npos)
      << guests.back().downs.front();
  expect_logged("'pc2' is not accepted: certificate has expired");
}

// As one that is years behind after its boot, until chronyd has set it.
TEST_F(SecureServer, TakesAHostAsSoonAsTheClockIsRight) {
  Authority::Subject coming = Authority::host("pc2");
  coming.valid_from = 2s;
  Guest& guest = dial(with(issue(coming), "pc2"));
  EXPECT_NE(wait_for_down(guest).find("compare the clocks"), std::string::npos)
      << guest.downs.front();
  expect_logged("'pc2' is not accepted: certificate is not yet valid");
  run_until(loop, [&] { return guest.them.has_value(); });
  EXPECT_TRUE(guest.them);
}

// A program of this PC that has no credentials.
TEST_F(SecureServer, TakesPlainConnectionsFromItsOwnPc) {
  wait_until_up(dial(greeting_of("pc1", "viewer")));
}

TEST_F(SecureServer, BelievesHeartbeatsOfHostsWithACertificateOnly) {
  dial(greeting_of("pc3"));  // from its own PC, where a program may say that it is any host
  dial(with(issue(Authority::program("viewer")), "pc4", "viewer"));
  dial(with(issue(Authority::host("pc2")), "pc2"));
  for (Guest& guest : guests) {
    wait_until_up(guest);
    guest.dialer.connection()->send(with_serial(1, ping_frame()));
    run_until(loop, [&] { return !guest.frames.empty(); });
    EXPECT_TRUE(guest.frames[0].has_pong());
  }
  EXPECT_EQ(heartbeats, std::vector<std::string>{"pc2"});
}

TEST_F(SecureServer, EndsConnectionsOfARevokedHostAtAReload) {
  Guest& good = dial(with(issue(Authority::host("pc2")), "pc2"));
  Guest& bad = dial(with(issue(Authority::host("pc3")), "pc3"));
  wait_until_up(good);
  wait_until_up(bad);
  authority.write_revoked(serials["pc3"], folder("pc1"));
  own->now = load("pc1")->now;
  server.on_new_credentials();
  EXPECT_NE(wait_for_down(bad).find("'pc3' is not accepted: certificate revoked"),
            std::string::npos)
      << bad.downs.front();
  run_until(loop, [&] { return bad.downs.size() > 1; });
  EXPECT_NE(bad.downs.back().find("certificate revoked"), std::string::npos) << bad.downs.back();
  EXPECT_TRUE(good.them) << "the connection goes on";
  EXPECT_TRUE(good.downs.empty());
}

TEST_F(SecureServer, ResumesTheSessionOfAHostThatConnectsAgain) {
  Guest& guest = dial(with(issue(Authority::host("pc2")), "pc2"));
  wait_until_up(guest);
  const auto before = guest.dialer.connection()->peer()->certificates;
  guest.dialer.restart({Errc::unavailable, "cut"});
  wait_for_down(guest);
  guest.downs.clear();
  wait_until_up(guest);
  EXPECT_EQ(guest.dialer.connection()->peer()->certificates, before) << "no new one was received";
  EXPECT_EQ(guest.dialer.connection()->peer()->str(), "host 'pc1'");
}

TEST_F(SecureServer, IsLeftByAHostThatDoesNotAcceptItAnyMore) {
  auto credentials = issue(Authority::host("pc2"));
  Guest& guest = dial(with(credentials, "pc2"));
  wait_until_up(guest);
  guest.dialer.on_new_credentials();
  EXPECT_TRUE(guest.downs.empty());
  authority.write_revoked(serials["pc1"], folder("pc2"));
  credentials->now = load("pc2")->now;
  guest.dialer.on_new_credentials();
  EXPECT_NE(wait_for_down(guest).find("'pc1' is not accepted: certificate revoked"),
            std::string::npos)
      << guest.downs.front();
}

// Those who connect and say nothing keep nobody out.
TEST_F(SecureServer, GivesUpTheOldestHandshakeForANewOne) {
  const wire::SocketAddress at =
      wire::resolve_number(wire::Address::parse(network.addresses().front()).value()).at(0);
  std::vector<UniqueFd> silent;
  for (int i = 0; i < 12; ++i) {
    silent.emplace_back(::socket(AF_INET, SOCK_STREAM | SOCK_CLOEXEC, 0));
    ASSERT_EQ(::connect(silent.back().get(), at.get(), at.length), 0);
  }
  Guest& guest = dial(with(issue(Authority::host("pc2")), "pc2"));
  wait_until_up(guest);
  char byte = 0;
  EXPECT_EQ(::recv(silent.front().get(), &byte, 1, MSG_DONTWAIT), 0) << "the oldest was closed";
  EXPECT_EQ(::recv(silent.back().get(), &byte, 1, MSG_DONTWAIT), -1) << "not the newest";
}

// Each address may have fewer than all.
TEST_F(SecureServer, GivesUpAHandshakeOfTheAddressWithTheMost) {
  const wire::SocketAddress at =
      wire::resolve_number(wire::Address::parse(network.addresses().front()).value()).at(0);
  std::vector<UniqueFd> silent;
  const auto connect_from = [&](const char* number) {
    const wire::SocketAddress from =
        wire::resolve_number(wire::Address::parse(number, 0, true).value()).at(0);
    silent.emplace_back(::socket(AF_INET, SOCK_STREAM | SOCK_CLOEXEC, 0));
    ASSERT_EQ(::bind(silent.back().get(), from.get(), from.length), 0);
    ASSERT_EQ(::connect(silent.back().get(), at.get(), at.length), 0);
  };
  for (const char* number : {"127.0.0.2", "127.0.0.3", "127.0.0.4", "127.0.0.5", "127.0.0.6"}) {
    connect_from(number);
  }
  for (int i = 0; i < 3; ++i) connect_from("127.0.0.7");
  wait_until_up(dial(with(issue(Authority::host("pc2")), "pc2")));
  std::vector<bool> closed;
  for (const UniqueFd& one : silent) {
    char byte = 0;
    closed.push_back(::recv(one.get(), &byte, 1, MSG_DONTWAIT) == 0);
  }
  EXPECT_EQ(closed, (std::vector<bool>{0, 0, 0, 0, 0, 1, 0, 0}));
}

TEST_F(SecureServer, LeavesTheLoopToOtherWorkDuringAFloodOfHandshakes) {
  HandshakeBudget budget(loop);
  std::list<Handshake> handshakes;
  std::vector<wire::TlsHandshake> flood;
  const std::shared_ptr<const wire::TlsCredentials> credentials =
      issue(Authority::host("pc2"))->now;
  for (int i = 0; i < 30; ++i) {
    int ends[2];
    ASSERT_EQ(::socketpair(AF_UNIX, SOCK_STREAM | SOCK_NONBLOCK | SOCK_CLOEXEC, 0, ends), 0);
    const auto end = wire::TransportEnd::connected;
    flood.emplace_back(credentials, wire::make_transport(UniqueFd(ends[0]), end), end);
    ASSERT_FALSE(flood.back().go_on().value()) << "sends the first message";
    handshakes.emplace_back(loop, own->now, UniqueFd(ends[1]), budget, false, [](const auto&) {});
  }
  const auto answered = [&] {
    return std::count_if(flood.begin(), flood.end(), [](const wire::TlsHandshake& one) {
      pollfd ready{one.fd(), POLLIN, 0};
      return ::poll(&ready, 1, 0) == 1;
    });
  };
  for (std::ptrdiff_t before = 0, now = 0; now < std::ssize(flood); before = now) {
    run_turns(loop);
    now = answered();
    EXPECT_LE(now - before, HandshakeBudget::kPerTurn);
  }
}

// As after a cut, when all connections to another host begin again.
TEST_F(SecureServer, LeavesTheLoopToOtherWorkWhileManyConnect) {
  HandshakeBudget budget(loop);
  std::list<wire::TlsTicket> tickets;
  std::list<Handshake> handshakes;
  std::vector<UniqueFd> others;
  for (int i = 0; i < 30; ++i) {
    int ends[2];
    ASSERT_EQ(::socketpair(AF_UNIX, SOCK_STREAM | SOCK_NONBLOCK | SOCK_CLOEXEC, 0, ends), 0);
    others.emplace_back(ends[0]);
    handshakes.emplace_back(loop, own->now, UniqueFd(ends[1]), tickets.emplace_back(), budget,
                            [](const auto&) {});
  }
  const auto begun = [&] {
    return std::count_if(others.begin(), others.end(), [](const UniqueFd& one) {
      pollfd ready{one.get(), POLLIN, 0};
      return ::poll(&ready, 1, 0) == 1;
    });
  };
  for (std::ptrdiff_t before = 0, now = 0; now < std::ssize(others); before = now) {
    run_turns(loop);
    now = begun();
    EXPECT_LE(now - before, HandshakeBudget::kPerTurn);
  }
}

// From other PCs.
TEST_F(SecureServer, TellsAPlainProgramWhatIsMissing) {
  int ends[2];
  ASSERT_EQ(::socketpair(AF_UNIX, SOCK_STREAM | SOCK_NONBLOCK | SOCK_CLOEXEC, 0, ends), 0);
  const UniqueFd program(ends[0]);
  std::optional<Error> refused;
  HandshakeBudget budget(loop);
  Handshake handshake(loop, own->now, UniqueFd(ends[1]), budget, false,
                      [&](Result<std::unique_ptr<wire::Transport>> result) {
                        ASSERT_FALSE(result);
                        refused = result.error();
                      });
  const Bytes hello = to_bytes(hello_frame(greeting_of("pc2", "viewer")));
  ASSERT_EQ(::send(program.get(), hello.data(), hello.size(), 0),
            static_cast<ssize_t>(hello.size()));
  run_until(loop, [&] { return refused.has_value(); });
  EXPECT_EQ(refused->message, "the other side does not speak TLS");
  Bytes answer(4096);
  const ssize_t count = ::recv(program.get(), answer.data(), answer.size(), 0);
  ASSERT_GT(count, 0);
  answer.resize(static_cast<std::size_t>(count));
  const net::Frame frame = frames_of(answer).at(0);
  EXPECT_NE(frame.failure().message().find("'pc1' takes encrypted connections only"),
            std::string::npos)
      << frame.failure().message();
}

TEST_F(SecureServer, EndsAHandshakeThatDoesNotGoOn) {
  int ends[2];
  ASSERT_EQ(::socketpair(AF_UNIX, SOCK_STREAM | SOCK_NONBLOCK | SOCK_CLOEXEC, 0, ends), 0);
  const UniqueFd other(ends[0]);
  bool ended = false;
  const MonoTime begin = loop.now();
  wire::TlsTicket ticket;
  HandshakeBudget budget(loop);
  Handshake handshake(loop, own->now, UniqueFd(ends[1]), ticket, budget,
                      [&](const Result<std::unique_ptr<wire::Transport>>& result) {
                        ended = true;
                        EXPECT_FALSE(result);
                      });
  run_until(loop, [&] { return ended; });
  EXPECT_EQ(loop.now() - begin, wire::kHelloTimeout);
}

}  // namespace
}  // namespace dssm::daemon
