// SPDX-License-Identifier: Apache-2.0
//
// What configured peers become in the catalog: hosts that come and go, fall silent, answer at two
// addresses, share a name, or are this very dssmd.
#include "daemon/fleet/peers.hpp"

#include <gtest/gtest.h>

#include <algorithm>

#include "tests/support/log_recorder.hpp"
#include "tests/unit/daemon/daemon_fixtures.hpp"
#include "tests/unit/daemon/scripted_host.hpp"

namespace dssm::daemon {
namespace {

class PeersTest : public testing::Test {
 protected:
  EventLoop loop = EventLoop::open(TimerQueue::Time::simulated).value();
  Resolver resolver{loop};
  Catalog catalog{"pc1"};
  LogRecorder log;
  wire::Greeting self = greeting_of("pc1");
  ScriptedPeer one{loop}, two{loop};
  std::unique_ptr<Peers> peers;

  void start(const std::vector<ScriptedPeer*>& configured) {
    std::vector<wire::Address> addresses;
    for (ScriptedPeer* peer : configured) addresses.push_back(peer->address());
    peers = std::make_unique<Peers>(loop, resolver, addresses, self, catalog, log);
  }
  void wait(const std::function<bool()>& done) { run_until(loop, done); }
  void wait_for_startup() {
    wait([this] { return peers->startup_is_over(); });
  }
  local::Host host(std::size_t index) const { return peers->report().hosts().at(index); }
};

TEST_F(PeersTest, AreSettledAtOnceWithoutAny) {
  start({});
  EXPECT_TRUE(peers->startup_is_over());
  EXPECT_TRUE(peers->report().hosts().empty());
}

TEST_F(PeersTest, PutAHostAndItsStreamsIntoTheCatalog) {
  one.streams = {"lidar", "imu"};
  start({&one});
  bool is_over = false;
  peers->on_startup_over([&] { is_over = true; });
  EXPECT_FALSE(peers->startup_is_over());
  wait([&] { return is_over; });
  EXPECT_TRUE(peers->startup_is_over());
  ASSERT_EQ(catalog.hosts().size(), 1u);
  const KnownHost& known = catalog.hosts().begin()->second;
  EXPECT_EQ(known.greeting.host, "pc2");
  EXPECT_EQ(known.address, one.address());
  EXPECT_EQ(known.streams.size(), 2u);
  EXPECT_EQ(known.streams.at({"lidar", 0}).id.str(), "lidar:0@pc2");
  one.send_event("lidar", true);
  one.send_event("gps", false);
  wait([&] { return known.streams.contains({"gps", 0}); });
  EXPECT_EQ(known.streams.size(), 2u);
  const local::Host shown = host(0);
  EXPECT_EQ(shown.name(), "pc2");
  EXPECT_EQ(shown.state(), local::Host::UP);
  EXPECT_EQ(shown.streams(), 2u);
  EXPECT_EQ(shown.error(), "");
  EXPECT_FALSE(shown.insecure());
  EXPECT_TRUE(log.contains("host 'pc2'"));
}

TEST_F(PeersTest, MeasureTheRoundTripAndTakeTheClock) {
  start({&one});
  for (const int milliseconds : {5, 3, 7, 0}) {
    one.delay = std::chrono::milliseconds(milliseconds);
    wait([&, before = one.pings] { return one.pings > before; });
  }
  const local::Host shown = host(0);  // after three answers
  EXPECT_EQ(shown.round_trip_ns(), 7'000'000);
  EXPECT_EQ(shown.least_round_trip_ns(), 3'000'000);
  EXPECT_EQ(shown.clock().bound_ns(), 1000);
  EXPECT_EQ(catalog.hosts().begin()->second.greeting.clock->clock.bound, Duration(1000));
}

TEST_F(PeersTest, SayWhatTheNetworkCarriesUntilTheConnectionEnds) {
  one.carried_bytes_per_s = 12'000'000;
  start({&one});
  wait([&] { return host(0).carried_bytes_per_s() == 12'000'000; });
  one.carried_bytes_per_s = 0;
  wait([&] { return host(0).carried_bytes_per_s() == 0; });
  one.carried_bytes_per_s = 1;
  wait([&] { return host(0).carried_bytes_per_s() == 1; });
  one.cut();
  wait([&] { return host(0).carried_bytes_per_s() == 0; });
}

TEST_F(PeersTest, TakeAHostOutWhenItsConnectionBreaks) {
  one.streams = {"lidar"};
  start({&one});
  wait_for_startup();
  one.cut();
  wait([&] { return catalog.hosts().empty(); });
  EXPECT_TRUE(log.contains("host 'pc2' is down"));
  wait([&] { return catalog.has({"lidar", 0, "pc2"}); });
  EXPECT_EQ(one.watches, 2);
  EXPECT_EQ(host(0).state(), local::Host::UP);
}

TEST_F(PeersTest, ReportAllStreamsOfAHostThatIsDown) {
  struct Observer final : CatalogObserver {
    void on_remote_stream_removed(const KnownHost&, const StreamInfo&) override { ++removed; }
    std::size_t removed = 0;
  } observer;
  constexpr int kStreams = 6 * Catalog::kRemovedPerTurn;
  for (int i = 0; i < kStreams; ++i) one.streams.push_back("s" + std::to_string(i));
  start({&one});
  wait_for_startup();
  catalog.add_observer(observer);
  one.streams = {};
  one.cut();
  wait([&] { return observer.removed == kStreams; });
  catalog.remove_observer(observer);
}

TEST_F(PeersTest, TakeAHostOutWhenItStopsAnswering) {
  start({&one});
  wait([&] { return one.pings >= 1; });
  one.answers_heartbeat = false;
  const MonoTime begin = loop.now();
  wait([&] { return catalog.hosts().empty(); });
  EXPECT_GE(loop.now() - begin, wire::kPeerTimeout - wire::kHeartbeat);
  EXPECT_EQ(host(0).state(), local::Host::DOWN);
  EXPECT_EQ(host(0).reason(), local::Host::NO_ANSWER);
  EXPECT_NE(host(0).error().find("no bytes came from host 'pc2'"), std::string::npos)
      << host(0).error();
  one.answers_heartbeat = true;
  wait([&] { return !catalog.hosts().empty(); });
}

TEST_F(PeersTest, ReportTheFourTimesOfAHeartbeat) {
  const auto heartbeat = [this] {
    wait([&, before = one.pings] { return one.pings > before + 1; });
    return catalog.hosts().begin()->second.greeting.clock->heartbeat.value();
  };
  one.ping_received_ns = 7;
  one.pong_sent_ns = 9;
  const RawTime before = RawClock::now();
  start({&one});
  const clock::HeartbeatTimes times = heartbeat();
  EXPECT_EQ(times.received, RawTime(Duration(7)));
  EXPECT_EQ(times.sent, RawTime(Duration(9)));
  EXPECT_GE(times.asked, before);
  EXPECT_GT(times.answered, times.asked);
  EXPECT_LE(times.answered, RawClock::now());
  one.ping_received_ns = 0;  // a dssmd that does not say it
  wait([&, pings = one.pings] { return one.pings > pings + 1; });
  EXPECT_EQ(heartbeat().received, RawTime(Duration(9)));
}

// The other PC needs them for its own measurement.
TEST_F(PeersTest, TellWhenAHeartbeatLeftAndTheAnswerBeforeCame) {
  start({&one});
  const RawTime begin = RawClock::now();
  wait([&] { return one.pings >= 2; });
  const net::Ping second = one.last_ping;
  EXPECT_GE(second.answered_ns(), to_ns(begin));
  EXPECT_GE(second.raw_ns(), second.answered_ns());
  one.delay = wire::kHeartbeat * 3 / 2;
  wait([&] { return one.pings >= 5; });
  EXPECT_GE(one.last_ping.raw_ns(), second.raw_ns());
  EXPECT_EQ(one.last_ping.answered_ns(), 0) << "the answer before is still under way";
}

TEST_F(PeersTest, BeatWithTheOtherHost) {
  start({&one});
  wait([&] { return one.pings >= 2; });
  const MonoTime begin = loop.now();
  const int before = one.pings;
  PeerConnection& connection = *peers->connection_to(one.host().greeting.host_id);
  connection.on_their_heartbeat();  // too early
  bool is_later = false;
  EventSource later = EventSource::timer(loop, [&] {
    connection.on_their_heartbeat();
    is_later = true;
  });
  later.enable_in(wire::kHeartbeat * 3 / 4);
  wait([&] { return is_later; });
  EXPECT_EQ(one.pings, before);
  wait([&] { return one.pings == before + 1; });
  EXPECT_EQ(loop.now() - begin, wire::kHeartbeat * 3 / 4);
  wait([&] { return one.pings == before + 2; });
  EXPECT_EQ(loop.now() - begin, wire::kHeartbeat * 3 / 4 + PeerConnection::kFollow)
      << "so late that theirs would have come before";
  wait([&] { return one.pings == before + 3; });
  EXPECT_EQ(loop.now() - begin, wire::kHeartbeat * 7 / 4 + PeerConnection::kFollow);
}

TEST_F(PeersTest, RepeatAHeartbeatOnceThatWasAnsweredLate) {
  start({&one});
  one.delay = std::chrono::milliseconds(1);
  wait([&] { return one.pings >= 3; });
  PeerConnection& connection = *peers->connection_to(one.host().greeting.host_id);
  const auto pass = [this](Duration time) {
    const MonoTime end = loop.now() + time;
    bool is_over = false;
    EventSource over = EventSource::timer(loop, [&] { is_over = true; });
    over.enable_in(time);
    wait([&] { return is_over; });
    EXPECT_EQ(loop.now(), end);
  };
  const auto next_second = [&](bool do_they_beat) {
    if (do_they_beat) connection.on_their_heartbeat();
    const int before = one.pings;
    wait([&] { return one.pings > before; });
    pass(wire::kHeartbeat / 4);
    return one.pings - before;
  };
  EXPECT_EQ(next_second(true), 1) << "as fast as the fastest";
  one.delay = std::chrono::milliseconds(10);
  for (int i = 0; i < 3; ++i) {
    EXPECT_EQ(next_second(true), 2);
    EXPECT_EQ(next_second(true), 1) << "too soon for another one";
  }
  pass(wire::kHeartbeat / 2);
  const int before = one.pings;
  connection.on_their_heartbeat();
  pass(wire::kHeartbeat / 4);
  EXPECT_EQ(one.pings - before, 1) << "it followed theirs";
  for (int i = 0; i < 5; ++i) EXPECT_EQ(next_second(false), i == 0 ? 2 : 1) << "they send none";
}

TEST_F(PeersTest, RefuseAPeerThatSendsInvalidStreamEvents) {
  start({&one});
  wait_for_startup();
  one.send_event("a:b", false);
  wait([&] { return catalog.hosts().empty(); });
  EXPECT_EQ(host(0).state(), local::Host::REFUSED);
  EXPECT_EQ(host(0).reason(), local::Host::NOT_ACCEPTED);
  EXPECT_NE(host(0).error().find("a stream event"), std::string::npos) << host(0).error();
}

TEST_F(PeersTest, LetNoPeerReportStreamsOfAnotherHost) {
  start({&one});
  wait_for_startup();
  one.send_event("lidar", false, "pc3");
  wait([&] { return !catalog.hosts().begin()->second.streams.empty(); });
  EXPECT_TRUE(catalog.has({"lidar", 0, "pc2"}));
}

TEST_F(PeersTest, SettleWhenAPeerIsNotThereAndReportWhy) {
  const wire::Address closed = ScriptedHost(loop).address();
  peers = std::make_unique<Peers>(loop, resolver, std::vector{closed}, self, catalog, log);
  wait_for_startup();
  EXPECT_EQ(host(0).state(), local::Host::DOWN);
  EXPECT_EQ(host(0).name(), "");
  EXPECT_EQ(host(0).reason(), local::Host::CONNECTION_REFUSED);
  EXPECT_NE(host(0).error().find("refused"), std::string::npos) << host(0).error();
  EXPECT_NE(peers->report().unavailable_peers().find(closed.str()), std::string::npos);
  wait([&] { return host(0).since_ns() > 300'000'000; });  // several attempts
  EXPECT_EQ(std::count_if(log.notices.begin(), log.notices.end(),
                          [](const std::string& line) {
                            return line.find("is not available, retrying") != std::string::npos;
                          }),
            1)
      << "once, not at each attempt";
}

TEST_F(PeersTest, SettleAfterAWhileWhenAPeerSendsNothing) {
  const UniqueFd listening = listen_on_loopback();  // accepts connections, and sends nothing
  const auto address =
      wire::Address::parse(wire::local_address(listening.get()).value().str()).value();
  peers = std::make_unique<Peers>(loop, resolver, std::vector{address}, self, catalog, log);
  wait_for_startup();
  EXPECT_EQ(host(0).state(), local::Host::CONNECTING);
}

TEST_F(PeersTest, UseOneOfTwoAddressesAndTakeTheOtherWhenItFails) {
  two.greet_as(one.host().greeting);
  one.streams = two.streams = {"lidar"};
  start({&one, &two});
  wait([&] { return one.watches + two.watches > 0 && peers->startup_is_over(); });
  ASSERT_EQ(one.watches + two.watches, 1) << "only one is used";
  ScriptedPeer& used = one.watches ? one : two;
  ScriptedPeer& spare = one.watches ? two : one;
  const std::size_t spare_index = one.watches ? 1 : 0;
  EXPECT_EQ(host(spare_index).state(), local::Host::UP);
  EXPECT_NE(host(spare_index).error().find("same host as '" + used.address().str()),
            std::string::npos)
      << host(spare_index).error();
  EXPECT_EQ(catalog.hosts().size(), 1u);
  wait([&] { return spare.pings >= 1; });
  used.cut();
  wait([&] { return spare.watches == 1; });
  EXPECT_EQ(catalog.hosts().begin()->second.address, spare.address());
  wait([&] { return catalog.has({"lidar", 0, "pc2"}); });
  EXPECT_EQ(host(spare_index).error(), "");
}

TEST_F(PeersTest, WarnOfTwoPcsWithOneIdAndUseTheFirst) {
  wire::Greeting clone = one.host().greeting;
  ++clone.instance_id;
  two.greet_as(clone);
  start({&one, &two});
  wait([&] { return one.watches + two.watches > 0 && peers->startup_is_over(); });
  ASSERT_EQ(one.watches + two.watches, 1);
  const local::Host spare = host(one.watches ? 1 : 0);
  EXPECT_NE(spare.error().find("but is another dssmd"), std::string::npos) << spare.error();
}

TEST_F(PeersTest, KeepTwoHostsOfOneNameAndWarnAtBoth) {
  wire::Greeting namesake = greeting_of("pc2");
  namesake.host_id[0] = static_cast<std::uint8_t>(namesake.host_id[0] + 1);
  two.greet_as(namesake);
  start({&one, &two});
  wait_for_startup();
  EXPECT_EQ(catalog.hosts().size(), 2u);
  EXPECT_NE(host(0).error().find("is called 'pc2' too"), std::string::npos) << host(0).error();
  EXPECT_NE(host(1).error().find(one.address().str()), std::string::npos) << host(1).error();
  two.cut();
  wait([&] { return catalog.hosts().size() == 1; });
  EXPECT_EQ(host(0).error(), "") << "there is only one now";
}

TEST_F(PeersTest, RecognizeConnectionsOfConfiguredPeers) {
  start({&one});
  wait_for_startup();
  const auto address = [](const char* text) {
    return wire::resolve_number(wire::Address::parse(text).value()).at(0);
  };
  EXPECT_TRUE(peers->is_configured(address("127.0.0.1:40000"), nullptr)) << "from any port";
  EXPECT_TRUE(peers->is_configured(address("[::ffff:127.0.0.1]:40000"), nullptr));
  EXPECT_FALSE(peers->is_configured(address("127.0.0.2:40000"), nullptr));
  wire::CertifiedPeer certified{wire::CertifiedPeer::Kind::host, "pc2", one.host().greeting.host_id,
                                nullptr};
  EXPECT_TRUE(peers->is_configured(address("10.0.0.9:40000"), &certified));
  certified.kind = wire::CertifiedPeer::Kind::program;
  EXPECT_FALSE(peers->is_configured(address("10.0.0.9:40000"), &certified));
  certified = {wire::CertifiedPeer::Kind::host, "pc3", {}, nullptr};
  EXPECT_FALSE(peers->is_configured(address("10.0.0.9:40000"), &certified));
  peers->set_configured({});
  wait([&] { return peers->report().hosts().empty(); });
  EXPECT_FALSE(peers->is_configured(address("127.0.0.1:40000"), nullptr));
}

TEST_F(PeersTest, KnowThemselves) {
  one.greet_as(self);
  start({&one});
  wait_for_startup();
  EXPECT_EQ(host(0).state(), local::Host::SELF);
  EXPECT_EQ(host(0).error(), "");
  EXPECT_TRUE(catalog.hosts().empty());
  EXPECT_EQ(one.connections(), 1) << "left standing, not dialed again and again";
  EXPECT_EQ(peers->report().own_warning().text, "");
}

TEST_F(PeersTest, RefuseAnotherPcWithTheirOwnId) {
  wire::Greeting clone = self;
  ++clone.instance_id;
  one.greet_as(clone);
  start({&one});
  wait_for_startup();
  EXPECT_EQ(host(0).state(), local::Host::REFUSED);
  EXPECT_EQ(host(0).reason(), local::Host::DUPLICATE);
  EXPECT_EQ(peers->report().own_warning().reason, HostReason::duplicate);
  EXPECT_NE(host(0).error().find("machine id"), std::string::npos) << host(0).error();
  EXPECT_EQ(peers->report().own_warning().text, host(0).error());
  EXPECT_TRUE(catalog.hosts().empty());
}

TEST_F(PeersTest, DoNotShowTheStreamsOfAHostWithTheirOwnName) {
  wire::Greeting namesake = greeting_of("pc1");
  namesake.host_id[0] = static_cast<std::uint8_t>(namesake.host_id[0] + 1);
  one.greet_as(namesake);
  start({&one});
  wait_for_startup();
  EXPECT_TRUE(catalog.hosts().empty());
  EXPECT_EQ(one.watches, 0);
  EXPECT_EQ(host(0).reason(), local::Host::NAMESAKE);
  EXPECT_NE(host(0).error().find("as this one is"), std::string::npos) << host(0).error();
  EXPECT_EQ(peers->report().own_warning().text, host(0).error());
}

// --- configured peers change

TEST_F(PeersTest, DialNewlyConfiguredPeersAndKeepTheOthers) {
  start({&one});
  wait([&] { return one.watches == 1; });
  two.greet_as(greeting_of("pc3"));
  peers->set_configured({two.address(), one.address()});
  wait([&] { return catalog.hosts().size() == 2; });
  EXPECT_EQ(one.watches, 1) << "its connection is the one of before";
  EXPECT_EQ(peers->report().hosts().size(), 2u);
  EXPECT_EQ(host(0).name(), "pc2");
  EXPECT_EQ(host(1).name(), "pc3");
}

TEST_F(PeersTest, DropPeersThatAreNoLongerConfiguredAndFailTheirRequests) {
  one.streams = {"lidar"};
  start({&one});
  wait([&] { return catalog.has({"lidar", 0, "pc2"}); });
  std::string got;
  net::Frame request;
  request.mutable_get_property()->mutable_id()->set_name("lidar");
  peers->connection_to(one.host().greeting.host_id)->ask(request, [&](Result<net::Frame> answer) {
    got = answer.error().message;
  });
  peers->set_configured({});
  wait([&] { return peers->report().hosts().empty(); });
  EXPECT_TRUE(catalog.hosts().empty());
  EXPECT_EQ(peers->connection_to(one.host().greeting.host_id), nullptr);
  EXPECT_NE(got.find("no longer among the peers"), std::string::npos) << got;
}

TEST_F(PeersTest, DropPeersThatWereNeverUp) {
  const wire::Address closed = ScriptedHost(loop).address();
  peers = std::make_unique<Peers>(loop, resolver, std::vector{closed}, self, catalog, log);
  wait_for_startup();
  peers->set_configured({});
  wait([&] { return peers->report().hosts().empty(); });
  EXPECT_EQ(peers->report().unavailable_peers(), "");
}

TEST_F(PeersTest, DialAPeerAgainThatIsConfiguredAgain) {
  const std::vector<wire::Address> configured = {one.address()};
  start({&one});
  wait([&] { return one.watches == 1; });
  peers->set_configured({});
  peers->set_configured(configured);  // before the first is through
  wait([&] { return one.watches == 2 && peers->report().hosts().size() == 1; });
  EXPECT_EQ(host(0).state(), local::Host::UP);
  EXPECT_EQ(catalog.hosts().size(), 1u);
}

TEST_F(PeersTest, TryAtOnceWhenTheNetworkMayBeBack) {
  start({&one});
  wait_for_startup();
  one.cut();
  const auto run_without_timers = [&] {
    for (int i = 0; i < 1000; ++i) event_base_loop(loop.base(), EVLOOP_ONCE | EVLOOP_NONBLOCK);
  };
  run_without_timers();
  EXPECT_EQ(one.watches, 1) << "it pauses";
  peers->on_network_changed();
  run_without_timers();
  EXPECT_EQ(one.watches, 2);
}

// --- requests

TEST_F(PeersTest, CarryRequestsAndTheirAnswers) {
  start({&one});
  wait_for_startup();
  PeerConnection* link = peers->connection_to(one.host().greeting.host_id);
  ASSERT_TRUE(link);
  std::vector<std::string> got;
  std::size_t known_hosts = 0;  // when the last answer came
  const auto ask = [&](const std::string& name) {
    net::Frame request;
    request.mutable_get_property()->mutable_id()->set_name(name);
    link->ask(request, [&, name](Result<net::Frame> answer) {
      known_hosts = catalog.hosts().size();
      got.push_back(name + ": " +
                    (answer ? answer->property().property() : answer.error().message));
    });
  };
  ask("a");
  ask("b");
  wait([&] { return one.requests.size() == 2; });
  net::Frame second = answer_to(one.requests[1]);
  second.mutable_property()->set_property("B");
  one.send(second);
  one.fail(one.requests[0], Errc::not_found, "no such stream");
  wait([&] { return got.size() == 2; });
  EXPECT_EQ(got, (std::vector<std::string>{"b: B", "a: no such stream"}));
  ask("c");
  wait([&] { return one.requests.size() == 3; });
  one.cut();
  wait([&] { return got.size() == 3; });
  EXPECT_EQ(got[2].find("c: the connection to host 'pc2' ended before it answered"), 0u) << got[2];
  EXPECT_EQ(known_hosts, 0u) << "answered before the host was down";
  EXPECT_EQ(peers->connection_to(one.host().greeting.host_id), nullptr);
}

TEST_F(PeersTest, BoundTheRequestsThatWait) {
  start({&one});
  wait_for_startup();
  PeerConnection& link = *peers->connection_to(one.host().greeting.host_id);
  std::size_t refused = 0;
  for (std::size_t i = 0; i < PeerConnection::kMaxWaiting + 10; ++i) {
    net::Frame request;
    request.mutable_list();
    link.ask(request, [&](const Result<net::Frame>& answer) {
      if (!answer && answer.error().code == Errc::limit_exceeded) ++refused;
    });
  }
  EXPECT_GE(refused, 10u);
  net::Frame large;
  large.mutable_set_property()->set_property(
      std::string(PeerConnection::kMaxWaitingBytes + 1, 'x'));
  bool too_large = false;
  link.ask(large, [&](const Result<net::Frame>& answer) { too_large = !answer; });
  EXPECT_TRUE(too_large);
  EXPECT_FALSE(catalog.hosts().empty()) << "the connection does not suffer";
}

// Without them, the other host would seem to be dead.
TEST_F(PeersTest, BeatWhileTooManyRequestsWait) {
  one.delay = std::chrono::milliseconds(1);
  start({&one});
  wait_for_startup();
  PeerConnection& link = *peers->connection_to(one.host().greeting.host_id);
  wait([&] { return link.last_round_trip() > Duration::zero(); });  // no heartbeat waits
  bool is_full = false;
  while (!is_full) {
    net::Frame request;
    request.mutable_list();
    link.ask(request, [&](const Result<net::Frame>& answer) { is_full = !answer; });
  }
  const int before = one.pings;
  wait([&] { return one.pings == before + 3; });
  EXPECT_EQ(one.connections(), 1) << "it is the connection of these requests";
}

TEST_F(PeersTest, TakeFurtherRequestsAfterEachAnswer) {
  start({&one});
  wait_for_startup();
  PeerConnection& link = *peers->connection_to(one.host().greeting.host_id);
  for (std::size_t i = 0; i < 4; ++i) {
    net::Frame large;
    large.mutable_set_property()->set_property(
        std::string(PeerConnection::kMaxWaitingBytes / 3, 'x'));
    std::optional<bool> done;
    link.ask(large, [&](const Result<net::Frame>& answer) { done = answer.has_value(); });
    wait([&] { return one.requests.size() > i || done; });
    ASSERT_FALSE(done);
    net::Frame answer = answer_to(one.requests[i]);
    answer.mutable_done();
    one.send(answer);
    wait([&] { return done.has_value(); });
    EXPECT_TRUE(*done);
  }
}

TEST_F(PeersTest, EndAConnectionThatAnswersWithoutARequest) {
  start({&one});
  wait_for_startup();
  net::Frame answer;
  answer.set_serial(999);
  answer.mutable_done();
  one.send(answer);
  wait([&] { return catalog.hosts().empty(); });
  EXPECT_NE(host(0).error().find("a response without a request"), std::string::npos)
      << host(0).error();
}

}  // namespace
}  // namespace dssm::daemon
