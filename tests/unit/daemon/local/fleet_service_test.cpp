// SPDX-License-Identifier: Apache-2.0
//
// What FleetService tells programs of this host and of mDNS. What it does with streams of other
// hosts is tested with real ones (tests/process/mirror, tests/process/fleet).
#include "daemon/local/fleet_service.hpp"

#include <gtest/gtest.h>

#include "tests/support/log_recorder.hpp"
#include "tests/unit/daemon/daemon_fixtures.hpp"
#include "tests/unit/daemon/scripted_host.hpp"

namespace dssm::daemon {
namespace {

class FleetServiceTest : public testing::Test {
 protected:
  EventLoop loop = EventLoop::open(TimerQueue::Time::simulated).value();
  Resolver resolver{loop};
  Registry registry{"pc1", kLimits};
  LogRecorder log;
  const wire::Greeting self = greeting_of("pc1");
  const ChannelParts parts{loop, resolver, registry, log, self};
  Catalog catalog{"pc1"};
  RemoteStreams<Mirror> mirrors{parts, catalog};
  RemoteStreams<RemoteWriter> writers{parts, catalog};
  ScriptedPeer peer{loop, "pc1"};
  Peers peers{loop, resolver, {peer.address()}, self, catalog, log};
  FleetService fleet{loop,   {self, {"10.0.0.1:13776"}, true}, registry, catalog, peers, mirrors,
                     writers};
};

TEST_F(FleetServiceTest, ReportsThatMdnsIsOffUntilItsFirstState) {
  const local::Mdns shown = fleet.mdns();
  EXPECT_EQ(shown.phase(), local::Mdns::OFF);
  EXPECT_EQ(shown.error(), "");
  EXPECT_EQ(shown.announced(), 0u);
  EXPECT_FALSE(shown.own_host_seen());
}

TEST_F(FleetServiceTest, ReportsTheNewestStateOfMdns) {
  MdnsInfo state;
  state.phase = MdnsPhase::waiting;
  state.error = "no Avahi";
  peers.on_mdns_state(state);
  EXPECT_EQ(fleet.mdns().phase(), local::Mdns::WAITING);
  EXPECT_EQ(fleet.mdns().error(), "no Avahi");
  state.phase = MdnsPhase::running;
  state.error.clear();
  state.avahi_version = "avahi 0.8";
  state.announced = 3;
  state.withheld = 2;
  state.own_host_seen = true;
  state.hosts_heard = 5;
  peers.on_mdns_state(state);
  const local::Mdns shown = fleet.mdns();
  EXPECT_EQ(shown.phase(), local::Mdns::RUNNING);
  EXPECT_EQ(shown.error(), "");
  EXPECT_EQ(shown.avahi_version(), "avahi 0.8");
  EXPECT_EQ(shown.announced(), 3u);
  EXPECT_EQ(shown.withheld(), 2u);
  EXPECT_TRUE(shown.own_host_seen());
  EXPECT_EQ(shown.hosts_heard(), 5u);
}

TEST_F(FleetServiceTest, ReportsForeignTextInPrintableCharactersOnly) {
  MdnsInfo state;
  state.error = "more than \x1b[31m";
  state.avahi_version = "avahi\n0.8";
  peers.on_mdns_state(state);
  EXPECT_EQ(fleet.mdns().error().find('\x1b'), std::string::npos) << fleet.mdns().error();
  EXPECT_EQ(fleet.mdns().avahi_version().find('\n'), std::string::npos);
}

TEST_F(FleetServiceTest, ListsThisHostFirstAndWhatIsWrongWithIt) {
  wire::Greeting copy = self;
  ++copy.instance_id;
  peer.greet_as(copy);
  EXPECT_EQ(fleet.hosts().at(0).error(), "");
  run_until(loop, [&] { return fleet.hosts().at(1).state() == local::Host::REFUSED; });
  const local::Host shown = fleet.hosts().at(0);
  EXPECT_EQ(shown.name(), "pc1");
  EXPECT_EQ(shown.state(), local::Host::SELF);
  EXPECT_EQ(shown.addresses(0), "10.0.0.1:13776");
  EXPECT_TRUE(shown.insecure());
  EXPECT_NE(shown.error(), "");
  EXPECT_EQ(shown.error(), fleet.hosts().at(1).error());
}

}  // namespace
}  // namespace dssm::daemon
