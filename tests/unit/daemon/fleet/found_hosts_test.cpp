// SPDX-License-Identifier: Apache-2.0
//
// What the hosts that mDNS finds become: dialed, kept, changed to another of their addresses, and
// forgotten, whatever is announced.
#include <gtest/gtest.h>

#include <algorithm>

#include "core/base/text.hpp"
#include "daemon/fleet/peers.hpp"
#include "daemon/fleet/service_record.hpp"
#include "tests/support/log_recorder.hpp"
#include "tests/unit/daemon/scripted_host.hpp"

namespace dssm::daemon {
namespace {

MdnsInfo mdns_in(MdnsPhase phase) {
  MdnsInfo state;
  state.phase = phase;
  return state;
}

class FoundHostsTest : public testing::Test {
 protected:
  EventLoop loop = EventLoop::open(TimerQueue::Time::simulated).value();
  Resolver resolver{loop};
  Catalog catalog{"pc1"};
  LogRecorder log;
  const wire::Greeting self = greeting_of("pc1");
  const wire::Greeting pc2 = greeting_of("pc2");
  std::unique_ptr<ScriptedPeer> one = std::make_unique<ScriptedPeer>(loop);
  std::unique_ptr<ScriptedPeer> two = std::make_unique<ScriptedPeer>(loop);
  std::unique_ptr<Peers> peers;

  // Both are addresses of one host, unless a test says otherwise.
  FoundHostsTest() {
    one->greet_as(pc2);
    two->greet_as(pc2);
  }
  void start(const std::vector<wire::Address>& configured = {}, bool insecure = true) {
    peers = std::make_unique<Peers>(loop, resolver, configured, self, catalog, log);
    peers->expect_finder(insecure);
  }
  static wire::Address at(ScriptedPeer& peer) { return peer.address(); }
  wire::Address closed_address() { return ScriptedHost(loop).address(); }
  static FoundHost host_at(const std::vector<wire::Address>& addresses,
                           const std::string& name = "pc2") {
    FoundHost host;
    host.id = wire::host_id_for(name);
    host.name = name;
    host.protocol_version = wire::kNetworkProtocolVersion;
    host.addresses = addresses;
    return host;
  }
  void wait(const std::function<bool()>& done) { run_until(loop, done); }
  void wait_until_up() {
    wait([this] { return !catalog.hosts().empty(); });
  }
  void wait_until_down() {
    wait([this] { return catalog.hosts().empty(); });
  }
  // All that can happen without waiting for a timer.
  void run_without_timers() { run_turns(loop, 300); }
  local::Host host(std::size_t index = 0) const { return peers->report().hosts().at(index); }
  std::vector<std::string> found_by(std::size_t index = 0) const {
    const local::Host shown = host(index);
    return {shown.found_by().begin(), shown.found_by().end()};
  }
  wire::Address address_in_catalog() const { return catalog.hosts().at(pc2.host_id).address; }
};

TEST_F(FoundHostsTest, GoIntoTheCatalogWithTheirStreams) {
  one->streams = {"lidar", "imu"};
  start();
  peers->on_host_found(host_at({at(*one)}));
  EXPECT_EQ(host().state(), local::Host::CONNECTING);
  wait([&] { return catalog.has({"lidar", 0, "pc2"}) && catalog.has({"imu", 0, "pc2"}); });
  ASSERT_EQ(peers->report().hosts().size(), 1u);
  EXPECT_EQ(host().name(), "pc2");
  EXPECT_EQ(host().host_id(), std::string(pc2.host_id.begin(), pc2.host_id.end()));
  EXPECT_EQ(host().state(), local::Host::UP);
  EXPECT_EQ(host().streams(), 2u);
  EXPECT_EQ(host().error(), "");
  EXPECT_EQ(host().addresses_size(), 1);
  EXPECT_EQ(found_by(), std::vector<std::string>{"mdns"});
  EXPECT_EQ(peers->report().unavailable_peers(), "");
  EXPECT_TRUE(peers->connection_to(pc2.host_id));
}

TEST_F(FoundHostsTest, AreDialedAtTheirAddressesInTurn) {
  start();
  peers->on_host_found(host_at({closed_address(), closed_address(), at(*one), at(*two)}));
  wait_until_up();
  EXPECT_EQ(address_in_catalog(), at(*one));
  run_without_timers();
  EXPECT_EQ(two->connections(), 0) << "one connection is enough";
  ASSERT_EQ(host().addresses_size(), 4);
  EXPECT_EQ(host().addresses(0), at(*one).str()) << "the one that is used";
}

TEST_F(FoundHostsTest, ComeBackAtTheirBestAddressAfterARestart) {
  start();
  peers->on_host_found(host_at({at(*one), at(*two)}));
  wait_until_up();
  one->cut();
  wait_until_down();
  wait_until_up();
  EXPECT_EQ(address_in_catalog(), at(*one));
  EXPECT_EQ(two->connections(), 0);
}

TEST_F(FoundHostsTest, AreReachedAtAnotherAddressWhenTheFirstIsGone) {
  one->streams = two->streams = {"lidar"};
  start();
  peers->on_host_found(host_at({at(*one), at(*two)}));
  wait([&] { return catalog.has({"lidar", 0, "pc2"}); });
  one.reset();
  wait_until_down();
  wait([&] { return catalog.has({"lidar", 0, "pc2"}); });
  EXPECT_EQ(address_in_catalog(), at(*two)) << "which is where channels go";
}

TEST_F(FoundHostsTest, AreReachedAtAnotherAddressWhenTheFirstStopsAnswering) {
  one->answers_heartbeat = false;  // and takes connections all the same
  start();
  peers->on_host_found(host_at({at(*one), at(*two)}));
  wait_until_up();
  EXPECT_EQ(address_in_catalog(), at(*one));
  wait_until_down();
  wait_until_up();
  EXPECT_EQ(address_in_catalog(), at(*two));
  EXPECT_EQ(one->connections(), 1);
}

TEST_F(FoundHostsTest, KeepAConnectionThatWorksWhenTheAddressesChange) {
  start();
  peers->on_host_found(host_at({at(*one)}));
  wait_until_up();
  peers->on_host_found(host_at({at(*two)}));
  run_without_timers();
  EXPECT_EQ(address_in_catalog(), at(*one));
  EXPECT_TRUE(one->connected());
  one->cut();  // it would take a new connection
  wait_until_down();
  wait_until_up();
  EXPECT_EQ(address_in_catalog(), at(*two));
  EXPECT_EQ(one->connections(), 1);
}

TEST_F(FoundHostsTest, AreDialedAtOnceWhenTheyHaveNewAddresses) {
  start();
  peers->on_host_found(host_at({closed_address()}));
  wait([&] { return host().state() == local::Host::DOWN && host().since_ns() > 1'600'000'000; });
  EXPECT_NE(host().error().find("refused"), std::string::npos) << host().error();
  EXPECT_NE(peers->report().unavailable_peers().find("'pc2' (connect to"), std::string::npos)
      << peers->report().unavailable_peers();
  EXPECT_TRUE(log.contains("host 'pc2' (found by mDNS) is not available, retrying"));
  bool waited = false;  // for most of a pause
  EventSource timer = EventSource::timer(loop, [&] { waited = true; });
  timer.enable_in(channel::ConnectPlan::kMaxPause * 9 / 10);
  peers->on_host_found(host_at({at(*one)}));
  wait([&] { return waited || host().state() == local::Host::UP; });
  EXPECT_EQ(host().state(), local::Host::UP);
}

TEST_F(FoundHostsTest, AreNotDialedASecondTimeWhenTheyAreConfiguredToo) {
  one->streams = two->streams = {"lidar"};
  start({at(*one)});
  wait([&] { return catalog.has({"lidar", 0, "pc2"}); });
  peers->on_host_found(host_at({at(*two)}));
  run_without_timers();
  EXPECT_EQ(two->connections(), 0);
  ASSERT_EQ(peers->report().hosts().size(), 1u);
  EXPECT_EQ(found_by(), (std::vector<std::string>{"peer", "mdns"}));
  EXPECT_EQ(host().error(), "");
  one.reset();
  wait([&] { return two->watches == 1 && catalog.has({"lidar", 0, "pc2"}); });
  ASSERT_EQ(peers->report().hosts().size(), 2u);
  EXPECT_EQ(host(0).state(), local::Host::DOWN);
  EXPECT_EQ(host(1).state(), local::Host::UP);
  EXPECT_EQ(host(1).streams(), 1u);
  EXPECT_EQ(found_by(1), std::vector<std::string>{"mdns"});
}

TEST_F(FoundHostsTest, StopTryingWhenTheConfiguredConnectionComesUp) {
  one->greet_as(greeting_of("pc8"));
  two->greet_as(greeting_of("pc9"));
  start({at(*one)});
  wait_until_up();
  peers->on_host_found(host_at({at(*two)}));
  wait([&] {
    return peers->report().hosts().size() == 2 && host(1).state() == local::Host::REFUSED;
  });
  one->greet_as(pc2);
  one->cut();
  wait([&] { return catalog.find(pc2.host_id) != nullptr; });
  run_without_timers();
  const int before = two->connections();
  peers->on_host_found(host_at({at(*two), closed_address()}));  // which would be dialed at once
  run_without_timers();
  EXPECT_EQ(two->connections(), before);
  ASSERT_EQ(peers->report().hosts().size(), 1u);
  EXPECT_EQ(host().state(), local::Host::UP);
  EXPECT_EQ(peers->report().unavailable_peers(), "");
}

TEST_F(FoundHostsTest, StayInUseWhenTheConfiguredConnectionComesLater) {
  one->greet_as(greeting_of("pc9"));
  one->streams = two->streams = {"lidar"};
  start({at(*one)});
  wait_until_up();
  peers->on_host_found(host_at({at(*two)}));
  wait([&] { return catalog.has({"lidar", 0, "pc2"}); });
  EXPECT_EQ(peers->report().hosts().size(), 2u);
  one->greet_as(pc2);
  one->cut();
  wait([&] { return peers->report().hosts().size() == 1 && host().state() == local::Host::UP; });
  EXPECT_EQ(host().error(), "");
  EXPECT_EQ(host().streams(), 1u) << "it speaks for both";
  EXPECT_EQ(found_by(), (std::vector<std::string>{"peer", "mdns"}));
  run_without_timers();
  EXPECT_EQ(address_in_catalog(), at(*two));
  EXPECT_TRUE(two->connected());
  two.reset();
  wait([&] { return !catalog.hosts().empty() && address_in_catalog() == at(*one); });
  wait([&] { return one->watches == 2; });  // as pc9, and now
}

TEST_F(FoundHostsTest, StayWhileTheirConnectionIsUpWhenMdnsLosesThem) {
  start();
  peers->on_host_found(host_at({at(*one)}));
  wait_until_up();
  peers->on_host_lost(pc2.host_id);
  run_without_timers();
  EXPECT_EQ(host().state(), local::Host::UP);
  one->cut();
  wait([&] { return peers->report().hosts().empty(); });
  EXPECT_TRUE(catalog.hosts().empty());
  run_without_timers();
  EXPECT_EQ(one->connections(), 1) << "forgotten";
}

TEST_F(FoundHostsTest, StayWhenMdnsFindsThemAgain) {
  start();
  peers->on_host_found(host_at({at(*one)}));
  wait_until_up();
  peers->on_host_lost(pc2.host_id);
  run_without_timers();
  peers->on_host_found(host_at({at(*one)}));
  one->cut();
  wait_until_down();
  wait_until_up();
  EXPECT_EQ(one->connections(), 2);
}

TEST_F(FoundHostsTest, GoAtOnceWhenMdnsLosesThemWhileTheyAreDown) {
  start();
  peers->on_host_found(host_at({closed_address()}));
  wait([&] { return host().state() == local::Host::DOWN; });
  peers->on_host_lost(pc2.host_id);
  peers->on_host_lost(wire::host_id_for("pc3"));
  run_without_timers();
  EXPECT_TRUE(peers->report().hosts().empty());
  EXPECT_EQ(peers->report().unavailable_peers(), "");
}

TEST_F(FoundHostsTest, AreNotTakenForAnotherThatAnswersAtTheirAddress) {
  one->greet_as(greeting_of("pc3"));
  start();
  peers->on_host_found(host_at({at(*one)}));
  wait([&] { return host().state() == local::Host::REFUSED; });
  EXPECT_NE(host().error().find("dssmd of host 'pc3' answers at"), std::string::npos)
      << host().error();
  EXPECT_EQ(host().name(), "pc2");
  EXPECT_TRUE(catalog.hosts().empty());
  peers->on_host_found(host_at({at(*one), at(*two)}));
  wait_until_up();
  EXPECT_EQ(address_in_catalog(), at(*two)) << "the next address is tried too";
}

TEST_F(FoundHostsTest, AreNotDialedWhereAnotherHostIsUp) {
  start();
  peers->on_host_found(host_at({at(*one)}));
  wait_until_up();
  peers->on_host_found(host_at({at(*one)}, "pc3"));
  run_without_timers();
  ASSERT_EQ(peers->report().hosts().size(), 2u);
  EXPECT_EQ(host(1).state(), local::Host::REFUSED);
  EXPECT_NE(host(1).error().find("where host 'pc2' answers"), std::string::npos) << host(1).error();
  EXPECT_EQ(one->connections(), 1) << "it is not disturbed";
  EXPECT_EQ(host(0).state(), local::Host::UP);
  one->greet_as(greeting_of("pc3"));
  one->cut();
  wait([&] { return catalog.find(wire::host_id_for("pc3")) != nullptr; });
  run_without_timers();
  EXPECT_EQ(host(0).state(), local::Host::REFUSED) << "now it is the other way round";
}

TEST_F(FoundHostsTest, AreNeverThisVeryHost) {
  start();
  one->greet_as(self);
  peers->on_host_found(host_at({at(*one)}, "pc1"));
  wait([&] { return one->connections() == 1; });
  run_without_timers();
  EXPECT_TRUE(peers->report().hosts().empty()) << "an echo of our own announcement";
  EXPECT_EQ(peers->report().own_warning().text, "");
  EXPECT_EQ(peers->report().unavailable_peers(), "");
  EXPECT_TRUE(log.notices.empty());
}

TEST_F(FoundHostsTest, AreWarnedOfOnceWhenTheyHaveOurNameAndMachineId) {
  wire::Greeting copy = self;
  ++copy.instance_id;
  two->greet_as(copy);
  one->greet_as(self);
  start();
  // With the copy's address came one of our own.
  peers->on_host_found(host_at({at(*one), at(*two)}, "pc1"));
  wait([&] { return !peers->report().own_warning().text.empty(); });
  const std::string warning = peers->report().own_warning().text;
  for (const std::string& part : {at(*two).str(), hex(self.host_id),
                                  std::string("rm /etc/machine-id"), std::string("(key name)")}) {
    EXPECT_NE(warning.find(part), std::string::npos) << part << " is missing in " << warning;
  }
  ASSERT_EQ(peers->report().hosts().size(), 1u);
  EXPECT_EQ(host().state(), local::Host::REFUSED);
  EXPECT_EQ(host().error(), warning);
  EXPECT_EQ(host().addresses(0), at(*two).str());
  EXPECT_TRUE(catalog.hosts().empty());
  EXPECT_TRUE(two->connected()) << "it is not asked again and again";
  two->cut();
  wait([&] { return peers->report().own_warning().text.empty(); });
  wait([&] { return !peers->report().own_warning().text.empty(); });
  EXPECT_EQ(std::count_if(log.notices.begin(), log.notices.end(),
                          [](const std::string& line) {
                            return line.find("this host's name") != std::string::npos;
                          }),
            1);
  // It was given another name.
  peers->on_host_lost(self.host_id);
  two->greet_as(pc2);
  two->cut();
  peers->on_host_found(host_at({at(*two)}));
  wait_until_up();
  EXPECT_EQ(peers->report().hosts().size(), 1u);
  EXPECT_EQ(peers->report().own_warning().text, "");
}

TEST_F(FoundHostsTest, AreAskedThoughThisHostIsAmongItsOwnPeers) {
  wire::Greeting copy = self;
  ++copy.instance_id;
  one->greet_as(self);
  two->greet_as(copy);
  start({at(*one)});
  wait([&] { return host().state() == local::Host::SELF; });
  peers->on_host_found(host_at({at(*two)}, "pc1"));
  wait([&] { return !peers->report().own_warning().text.empty(); });
  ASSERT_EQ(peers->report().hosts().size(), 2u);
  EXPECT_EQ(host(0).state(), local::Host::SELF);
  EXPECT_EQ(found_by(0), std::vector<std::string>{"peer"});
  EXPECT_EQ(host(1).state(), local::Host::REFUSED);
}

TEST_F(FoundHostsTest, AreSaidToHaveOurIdAlsoWhenTheyMayNotBeAsked) {
  start({}, false);
  peers->on_host_found(host_at({{"192.0.2.7", 13776}}, "pc1"));
  run_without_timers();
  ASSERT_EQ(peers->report().hosts().size(), 1u);
  EXPECT_EQ(host().state(), local::Host::CLOSED);
  EXPECT_NE(host().error().find("with this host's name 'pc1' and machine id"), std::string::npos)
      << host().error();
}

TEST_F(FoundHostsTest, AreShownButNotDialedWhenTheyAreClosed) {
  FoundHost closed = host_at({});
  closed.closed = true;
  start();
  peers->on_host_found(closed);
  run_without_timers();
  EXPECT_EQ(host().state(), local::Host::CLOSED);
  EXPECT_EQ(host().reason(), local::Host::CLOSED_THERE);
  EXPECT_NE(host().error().find("set listen and credentials there"), std::string::npos);
  EXPECT_NE(peers->report().unavailable_peers().find("'pc2' (host 'pc2' listens"),
            std::string::npos)
      << peers->report().unavailable_peers();
  closed.addresses = {at(*one)};  // another dssmd of this PC
  peers->on_host_found(closed);
  wait_until_up();
  EXPECT_EQ(host().state(), local::Host::UP);
}

TEST_F(FoundHostsTest, AreShownButNotDialedWhenTheySpeakAnotherVersion) {
  FoundHost other = host_at({at(*one)});
  other.protocol_version = 77;
  start();
  peers->on_host_found(other);
  run_without_timers();
  EXPECT_EQ(host().state(), local::Host::REFUSED);
  proto::Hello hello;
  wire::to_message(pc2, hello);
  hello.set_protocol_version(77);
  hello.clear_version();
  EXPECT_EQ(host().error(), wire::greeting_untrusted(hello, "dssmd of host 'pc2'").error().message);
  EXPECT_EQ(one->connections(), 0);
  peers->on_host_found(host_at({at(*one)}));  // it was updated
  wait_until_up();
}

TEST_F(FoundHostsTest, AreNotReachedInTheClearUnlessThatIsAllowed) {
  start({}, false);
  peers->on_host_found(host_at({{"192.0.2.7", 13776}}, "pc3"));
  peers->on_host_found(host_at({{"192.0.2.8", 13776}, at(*one)}));
  wait_until_up();
  EXPECT_EQ(address_in_catalog(), at(*one)) << "a dssmd of this PC";
  EXPECT_EQ(host(0).state(), local::Host::CLOSED);
  EXPECT_EQ(host(0).reason(), local::Host::CLOSED_HERE);
  EXPECT_NE(host(0).error().find("no credentials to connect to others"), std::string::npos);
}

TEST_F(FoundHostsTest, AreBoundedInNumberAndAddresses) {
  start({}, false);
  for (int i = 0; i < 1000; ++i) {
    peers->on_host_found(host_at(std::vector<wire::Address>(100, {"192.0.2.7", 13776}),
                                 "pc" + std::to_string(1000 + i)));
  }
  run_without_timers();
  ASSERT_EQ(peers->report().hosts().size(), Peers::kMaxFoundHosts);
  EXPECT_EQ(static_cast<std::size_t>(host().addresses_size()), Peers::kMaxAddressesOfHost);
  EXPECT_EQ(std::count_if(log.notices.begin(), log.notices.end(),
                          [](const std::string& line) {
                            return line.find("more than 256 hosts") != std::string::npos;
                          }),
            1);
  EXPECT_LT(peers->report().unavailable_peers().size(), 4000u);
  EXPECT_NE(peers->report().unavailable_peers().find("and 248 more"), std::string::npos)
      << peers->report().unavailable_peers();
  peers->on_host_lost(wire::host_id_for("pc1000"));
  run_without_timers();
  peers->on_host_found(host_at({at(*one)}));
  wait_until_up();  // there was room again
}

TEST_F(FoundHostsTest, AreReachedThoughOneOfTheirAddressesNeverGreets) {
  const UniqueFd mute =
      wire::listen_tcp(wire::resolve_number({"127.0.0.1", 0}).at(0)).value();  // only connects
  const wire::SocketAddress bound = wire::local_address(mute.get()).value();
  const wire::Address never{"127.0.0.1", wire::Address::parse(bound.str()).value().port};
  start();
  peers->on_host_found(host_at({never}, "pc3"));
  peers->on_host_found(host_at({never, at(*one)}));
  wait([&] { return host(0).state() == local::Host::DOWN; });
  EXPECT_NE(host(0).error().find("does not greet"), std::string::npos) << host(0).error();
  wait_until_up();
  EXPECT_EQ(address_in_catalog(), at(*one));
}

TEST_F(FoundHostsTest, MayBeSeveralAtOneIpNumber) {
  const wire::Greeting pc3 = greeting_of("pc3");
  two->greet_as(pc3);
  start();
  peers->on_host_found(host_at({at(*one)}));
  peers->on_host_found(host_at({at(*two)}, "pc3"));
  wait([&] { return catalog.hosts().size() == 2; });
  EXPECT_EQ(host(0).state(), local::Host::UP);
  EXPECT_EQ(host(1).state(), local::Host::UP);
  EXPECT_EQ(catalog.hosts().at(pc3.host_id).address, at(*two));
}

TEST_F(FoundHostsTest, MayHaveOneName) {
  wire::Greeting namesake = pc2;
  ++namesake.host_id[0];
  two->greet_as(namesake);
  FoundHost second = host_at({at(*two)});
  second.id = namesake.host_id;
  start();
  peers->on_host_found(host_at({at(*one)}));
  peers->on_host_found(second);
  wait([&] { return catalog.hosts().size() == 2; });
  EXPECT_NE(host(0).error().find("is called 'pc2' too"), std::string::npos) << host(0).error();
  EXPECT_NE(host(1).error().find(at(*one).str()), std::string::npos) << host(1).error();
}

TEST_F(FoundHostsTest, AreWarnedOfWhenTheyHaveOurName) {
  wire::Greeting namesake = self;
  ++namesake.host_id[0];
  one->greet_as(namesake);
  FoundHost found = host_at({at(*one)}, "pc1");
  found.id = namesake.host_id;
  start();
  peers->on_host_found(found);
  wait([&] { return !peers->report().own_warning().text.empty(); });
  EXPECT_EQ(host().state(), local::Host::REFUSED);
  EXPECT_EQ(host().error(), peers->report().own_warning().text);
  EXPECT_TRUE(catalog.hosts().empty());
  run_without_timers();
  EXPECT_EQ(one->connections(), 1);
}

// A refused host, which another one is announced in place of, is reached as configured.
TEST_F(FoundHostsTest, AreGivenUpWhileOthersAreAnnouncedAtTheirAddress) {
  wire::Greeting namesake = self;
  ++namesake.host_id[0];
  one->greet_as(namesake), two->greet_as(namesake);
  FoundHost found = host_at({at(*one)}, "pc1");
  found.id = namesake.host_id;
  start();
  peers->on_host_found(found);
  wait([&] { return !peers->report().own_warning().text.empty(); });
  peers->on_host_found(host_at({at(*one)}, "pc3"));
  peers->set_configured({at(*two)});
  wait([&] { return two->connections() == 1; });
  run_without_timers();
  const auto hosts = peers->report().hosts();
  EXPECT_TRUE(std::any_of(hosts.begin(), hosts.end(), [&](const local::Host& each) {
    return each.error().find("is announced at '" + at(*one).str() + "', where host") !=
           std::string::npos;
  }));
}

// --- the first words

TEST_F(FoundHostsTest, AreWaitedForWhileMdnsWorks) {
  const MonoTime begin = loop.now();
  start({at(*one)});
  EXPECT_FALSE(peers->startup_is_over());
  bool is_over = false;
  peers->on_startup_over([&] { is_over = true; });
  peers->on_mdns_state(mdns_in(MdnsPhase::running));
  wait([&] { return is_over; });
  // The loop's clock is as coarse as the kernel's ticks.
  EXPECT_GE(loop.now() - begin, Peers::kStartupTime - std::chrono::milliseconds(20));
}

TEST_F(FoundHostsTest, AreNotWaitedForWithoutAvahi) {
  start();
  EXPECT_FALSE(peers->startup_is_over()) << "not before the finder said so";
  peers->on_mdns_state(mdns_in(MdnsPhase::waiting));
  EXPECT_TRUE(peers->startup_is_over());
}

TEST_F(FoundHostsTest, LetPeersBeWaitedForWithoutAvahi) {
  start({at(*one)});
  peers->on_mdns_state(mdns_in(MdnsPhase::waiting));
  EXPECT_FALSE(peers->startup_is_over());
  wait([&] { return peers->startup_is_over(); });
  EXPECT_EQ(one->watches, 1);
}

}  // namespace
}  // namespace dssm::daemon
