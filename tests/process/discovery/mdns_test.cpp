// SPDX-License-Identifier: Apache-2.0
//
// Mdns against real Avahi daemons on PCs of the test's own.
#include <gtest/gtest.h>

#include <chrono>
#include <memory>
#include <string>
#include <vector>

#include "tests/process/discovery/mdns_flood.hpp"
#include "tests/process/discovery/probe.hpp"
#include "tests/support/avahi_host.hpp"
#include "tests/support/network.hpp"

namespace dssm::test {
namespace {

using Words = std::vector<std::string>;

class MdnsNeedsRoot : public testing::Test {
 protected:
  // PCs with D-Bus and Avahi, called as `names` say.
  //   returns  false: the test is to be skipped, and has been told so
  bool make(const Words& names, bool running = true) {
    Result<std::unique_ptr<Network>> network = Network::open(static_cast<int>(names.size()));
    if (!network) return why_ = network.error().message, false;
    network_ = *std::move(network);
    for (std::size_t i = 0; i < names.size(); ++i) {
      Result<std::unique_ptr<AvahiHost>> pc =
          AvahiHost::open(*network_, static_cast<int>(i) + 1, names[i]);
      if (!pc) return why_ = pc.error().message, false;
      pcs_.push_back(*std::move(pc));
      if (!running) continue;
      pcs_.back()->start_dbus();
      pcs_.back()->start_avahi();
    }
    return true;
  }

  AvahiHost& pc(std::size_t number) { return *pcs_.at(number - 1); }

  std::string why_;
  std::unique_ptr<Network> network_;
  std::vector<std::unique_ptr<AvahiHost>> pcs_;
};

// Its newest line holds that.
bool has(const Probe& probe, int id, const std::string& text) {
  return probe.hosts().contains(id) && probe.hosts().at(id).find(text) != std::string::npos;
}

TEST_F(MdnsNeedsRoot, FindsAnotherHostAndLosesItWhenItEnds) {
  if (!make({"pc1", "pc2"})) GTEST_SKIP() << why_;
  Probe one(pc(1), 1, "pc1");
  Probe two(pc(2), 2, "pc2");
  EXPECT_TRUE(one.until([&] {
    return has(one, 2, "pc2 open 10.77.0.2:7000 [");  // IPv4 first, and an IPv6 one
  }));
  EXPECT_TRUE(two.until([&] { return has(two, 1, "pc1 open 10.77.0.1:7000"); }));
  EXPECT_TRUE(one.until_state({"running announced=1 withheld=0 own=1 heard=1", "version=avahi"}));
  EXPECT_FALSE(one.hosts().contains(1)) << "nobody is to be sent to oneself";
  EXPECT_EQ(one.hosts().at(2).find("127.0.0.1"), std::string::npos);
  two.finish();
  EXPECT_TRUE(one.until_lost(2));
  EXPECT_TRUE(one.until_state({"heard=0"}));
}

TEST_F(MdnsNeedsRoot, AnnouncesAStreamWithItsTxtRecordAndFollowsChanges) {
  if (!make({"pc1", "pc2"})) GTEST_SKIP() << why_;
  Probe one(pc(1), 1, "pc1");
  one.command("announce lidar:0 camera:1");
  ASSERT_TRUE(one.until_state({"announced=3"}));
  const std::string seen = raw_ask(pc(2), "resolve", "lidar:0@pc1", "_lidar._sub._dssm._tcp");
  EXPECT_TRUE(seen.starts_with("port 7000\n")) << seen;
  for (const char* text : {"txt host=pc1\n", "txt hid=01010101010101010101010101010101\n",
                           "txt name=lidar\n", "txt id=0\n", "txt bytes=64\n", "txt depth=8\n"}) {
    EXPECT_NE(seen.find(text), std::string::npos) << text << "is missing in " << seen;
  }
  // txtvers first, as RFC 6763 wants it.
  const std::string record = raw_ask(pc(1), "record", "lidar:0@pc1._dssm._tcp.local", "TXT");
  EXPECT_TRUE(record.starts_with("txt txtvers=1\ntxt host=pc1\n")) << record;
  one.command("announce lidar:0/16 camera:1");
  std::string changed;
  for (int tries = 0; tries < 100 && changed.find("depth=16") == changed.npos; ++tries) {
    changed = raw_ask(pc(2), "resolve", "lidar:0@pc1", "_dssm._tcp");
  }
  EXPECT_NE(changed.find("txt depth=16\n"), std::string::npos) << changed;
  one.command("announce camera:1");
  EXPECT_TRUE(one.until_state({"announced=2"}));
}

TEST_F(MdnsNeedsRoot, FindsBothOfTwoHostsWithOneName) {
  if (!make({"pc1", "pc1", "pc3"})) GTEST_SKIP() << why_;
  Probe one(pc(1), 1, "pc1");
  Probe two(pc(2), 2, "pc1");
  Probe three(pc(3), 3, "pc3");
  EXPECT_TRUE(three.until([&] {
    return has(three, 1, "pc1 open 10.77.0.1:7000") && has(three, 2, "pc1 open 10.77.0.2:7000");
  }));
  EXPECT_TRUE(one.until_state({"announced=1 withheld=0 own=1 heard=2"}));
  EXPECT_TRUE(two.until_state({"announced=1 withheld=0 own=1 heard=2"}));
}

TEST_F(MdnsNeedsRoot, AnnouncesEachStreamOfTwoHostsWithOneNameThatMeetLater) {
  if (!make({"pc1", "pc2", "pc3"})) GTEST_SKIP() << why_;
  network_->cut(2);
  Probe one(pc(1), 1, "twin");
  Probe two(pc(2), 2, "twin");
  one.command("announce lidar:0");
  two.command("announce lidar:0");
  ASSERT_TRUE(one.until_state({"announced=2"}));
  ASSERT_TRUE(two.until_state({"announced=2"}));
  network_->heal(2);
  EXPECT_TRUE(one.until_state({"announced=2 withheld=0 own=1 heard=1"}));
  EXPECT_TRUE(two.until_state({"announced=2 withheld=0 own=1 heard=1"}));
  // Avahi on pc3 may still know the name's last owner.
  std::string first, second;
  const auto has_both = [&] {
    const auto has = [](const std::string& seen, int id) {
      return seen.find(id == 1 ? "txt hid=01010101" : "txt hid=02020202") != seen.npos;
    };
    return (has(first, 1) && has(second, 2)) || (has(first, 2) && has(second, 1));
  };
  for (int tries = 0; tries < 100 && !has_both(); ++tries) {
    first = raw_ask(pc(3), "resolve", "lidar:0@twin", "_lidar._sub._dssm._tcp");
    second = raw_ask(pc(3), "resolve", "lidar:0@twin #2", "_lidar._sub._dssm._tcp");
  }
  EXPECT_TRUE(has_both()) << first << second;
}

TEST_F(MdnsNeedsRoot, FindsAnotherPcWithThisOnesNameAndIdButNotItself) {
  if (!make({"pc1", "pc1", "pc3"})) GTEST_SKIP() << why_;
  Probe one(pc(1), 1, "pc1");
  Probe copy(pc(2), 1, "pc1");
  Probe three(pc(3), 3, "pc3");
  const auto only_at = [](const Probe& probe, const std::string& there, const std::string& here) {
    return has(probe, 1, "pc1 open " + there + ":7000") && !has(probe, 1, here);
  };
  EXPECT_TRUE(one.until([&] { return only_at(one, "10.77.0.2", "10.77.0.1"); }));
  EXPECT_TRUE(copy.until([&] { return only_at(copy, "10.77.0.1", "10.77.0.2"); }));
  EXPECT_TRUE(one.until_state({"own=1 heard=2"}));
  EXPECT_FALSE(three.hosts().contains(3));
  copy.finish();
  EXPECT_TRUE(one.until_lost(1));
  EXPECT_TRUE(one.until_state({"own=1 heard=1"}));
}

TEST_F(MdnsNeedsRoot, FindsASecondHostOfTheSamePcByLoopback) {
  if (!make({"pc1", "pc2"})) GTEST_SKIP() << why_;
  Probe one(pc(1), 1, "pc1");
  Probe second(pc(1), 9, "demo");
  Probe closed(pc(1), 8, "shut", {"closed"});
  Probe far(pc(2), 2, "pc2");
  EXPECT_TRUE(one.until([&] { return has(one, 9, "demo open 127.0.0.1:7000 10.77.0.1:7000"); }));
  EXPECT_TRUE(one.until_found(8, "shut closed 127.0.0.1:7000"));
  EXPECT_TRUE(far.until_found(8, "shut closed"));
  EXPECT_TRUE(one.until_state({"heard=1"})) << "only the other PC was heard by multicast";
}

TEST_F(MdnsNeedsRoot, AnnouncesAndFindsAllAgainWhenAvahiWasKilledAndStarted) {
  if (!make({"pc1", "pc2"})) GTEST_SKIP() << why_;
  Probe one(pc(1), 1, "pc1");
  Probe two(pc(2), 2, "pc2");
  one.command("announce lidar:0");
  ASSERT_TRUE(one.until_state({"announced=2", "heard=1"}));
  ASSERT_TRUE(two.until_state({"heard=1"}));
  pc(1).kill_avahi();
  EXPECT_TRUE(one.until_state({"waiting announced=0", "avahi-daemon"}));
  EXPECT_TRUE(one.until_lost(2));
  pc(1).start_avahi();
  EXPECT_TRUE(one.until_state({"running announced=2", "own=1 heard=1"}));
  EXPECT_TRUE(one.until([&] { return has(one, 2, "pc2 open 10.77.0.2:7000"); }));
  const std::string seen = raw_ask(pc(2), "resolve", "lidar:0@pc1", "_lidar._sub._dssm._tcp");
  EXPECT_TRUE(seen.starts_with("port 7000\n")) << seen;
}

TEST_F(MdnsNeedsRoot, WaitsForDBusAndAvahiAndLogsItOnce) {
  if (!make({"pc1", "pc2"}, false)) GTEST_SKIP() << why_;
  pc(2).start_dbus();
  pc(2).start_avahi();
  Probe two(pc(2), 2, "pc2");
  Probe one(pc(1), 1, "pc1");
  EXPECT_TRUE(one.until_state({"waiting", "D-Bus"}));
  pc(1).start_dbus();
  EXPECT_TRUE(one.until_state({"waiting", "apt install avahi-daemon"}));
  pc(1).start_avahi();
  EXPECT_TRUE(one.until_state({"running announced=1", "own=1 heard=1"}));
  EXPECT_TRUE(two.until([&] { return has(two, 1, "pc1 open 10.77.0.1:7000"); }));
  EXPECT_EQ(one.count("log 4 mDNS waits"), 1);
  EXPECT_EQ(one.count("log 5 mDNS works"), 1);
  // The whole bus goes, as when dbus is upgraded.
  pc(1).kill_avahi();
  pc(1).kill_dbus();
  EXPECT_TRUE(one.until_state({"waiting"}));
  pc(1).start_dbus();
  pc(1).start_avahi();
  EXPECT_TRUE(one.until_state({"running announced=1", "own=1 heard=1"}));
}

TEST_F(MdnsNeedsRoot, AHungAvahiDaemonBlocksNeitherTheLoopNorTheEnd) {
  if (!make({"pc1"})) GTEST_SKIP() << why_;
  Probe one(pc(1), 1, "pc1");
  ASSERT_TRUE(one.until_state({"running announced=1"}));
  pc(1).pause_avahi();
  one.command("announce lidar:0");
  ASSERT_TRUE(one.until_it_waits_for_an_answer());
  one.command("tick");
  const auto before = std::chrono::steady_clock::now();
  EXPECT_TRUE(one.until([&] { return one.count("tock") == 1; }));
  one.finish();
  EXPECT_TRUE(one.until([&] { return one.count("ended") == 1; }));
  one.wait_for_end();
  // D-Bus would have waited for 25 s; the machine may take its time.
  EXPECT_LT(std::chrono::steady_clock::now() - before, std::chrono::seconds(15));
}

TEST_F(MdnsNeedsRoot, UsesOnlyTheInterfacesThatAreConfigured) {
  if (!make({"pc1", "pc2"})) GTEST_SKIP() << why_;
  Probe two(pc(2), 2, "pc2");
  Probe cable(pc(1), 1, "pc1", {"use=eth*"});
  EXPECT_TRUE(two.until([&] { return has(two, 1, "pc1 open 10.77.0.1:7000"); }));
  EXPECT_TRUE(cable.until([&] { return has(cable, 2, "pc2 open 10.77.0.2:7000"); }));
  Probe none(pc(1), 3, "pc3", {"use=wlan*"});
  EXPECT_TRUE(none.until_state({"running announced=0 withheld=1 own=0 heard=0", "'wlan*'"}));
  Probe avoiding(pc(1), 4, "pc4", {"avoid=eth0"});
  // On this PC's loopback it finds the others, and itself; eth0's results would have come first.
  EXPECT_TRUE(avoiding.until_state({"own=1 heard=0"}));
  EXPECT_FALSE(avoiding.hosts().contains(2));
}

TEST_F(MdnsNeedsRoot, WithholdsWhatIsBeyondAvahisLimitsAndLogsItOnce) {
  if (!make({"pc1", "pc2"})) GTEST_SKIP() << why_;
  Probe one(pc(1), 1, "pc1", {"pause=0"});
  one.command("many 800");
  EXPECT_TRUE(one.until_state({"announced=740 withheld=61", "objects-per-client-max"}));
  Probe two(pc(2), 2, "pc2");  // the browser's resolvers have their place all the same
  EXPECT_TRUE(one.until([&] { return has(one, 2, "pc2 open 10.77.0.2:7000"); }));
  EXPECT_TRUE(two.until([&] { return has(two, 1, "pc1 open 10.77.0.1:7000"); }));
  one.command("many 739");
  EXPECT_TRUE(one.until_state({"announced=740 withheld=0"}));
  EXPECT_EQ(one.count("log 4 mDNS: "), 1);
}

TEST_F(MdnsNeedsRoot, HostileRecordsHarmNoHost) {
  if (!make({"pc1", "pc2", "pc3"})) GTEST_SKIP() << why_;
  const std::string type = "_host:._sub._dssm._tcp";
  Probe three(pc(3), 3, "pc3");  // a good one in bad company
  ASSERT_TRUE(three.until_state({"running announced=1"}));
  Words oversized{"publish", "oversized", type, "1", "txtvers=1"};
  for (int i = 0; i < 25; ++i) oversized.push_back("k=" + std::string(250, 'x'));
  Words many{"publish", "many", type, "1", "txtvers=1"};
  for (int i = 0; i < 200; ++i) many.push_back("k" + std::to_string(i));
  const std::string hid = "hid=07070707070707070707070707070707";
  const RawService first(pc(3), oversized);
  const RawService second(pc(3), many);
  const RawService third(pc(3), {"publish", "empty \x1b[31m \n <4>forged", type, "1"});
  const RawService fourth(pc(3), {"publish", "newer", type, "1", "txtvers=2", "host=x", hid});
  const RawService fifth(pc(3), {"publish", "short", type, "1", "txtvers=1", "host=x", "hid=07"});
  const RawService sixth(pc(3), {"publish", "stream", type, "1", "txtvers=1", "host=x", hid,
                                 "proto=1", "name=lidar", "id=0", "bytes=1", "depth=8"});
  const RawService seventh(pc(3),
                           {"publish", "port", type, "0", "txtvers=1", "host=x", hid, "proto=1"});
  const RawService flood(pc(3), {"flood", "300", type});
  for (const RawService* raw : {&first, &third, &fourth, &fifth, &sixth, &seventh, &flood}) {
    EXPECT_TRUE(raw->published());
  }
  Probe one(pc(1), 1, "pc1");
  EXPECT_TRUE(one.until([&] { return one.count("log 4 mDNS: ") > 20; }));
  Probe two(pc(2), 2, "pc2");  // comes when the bad ones hold all the places
  EXPECT_TRUE(one.until([&] { return has(one, 2, "pc2 open 10.77.0.2:7000"); }));
  EXPECT_TRUE(two.until([&] { return has(two, 1, "pc1 open 10.77.0.1:7000"); }));
  EXPECT_FALSE(one.hosts().contains(7));
  EXPECT_TRUE(one.until_state({"heard=2"}));
  one.command("tick");
  EXPECT_TRUE(one.until([&] { return one.count("tock") == 1; }));
}

// More than an Avahi daemon remembers (4096 records), and each of them well-formed.
TEST_F(MdnsNeedsRoot, OutlivesTenThousandForgedHosts) {
  if (!make({"pc1", "pc2", "pc3"})) GTEST_SKIP() << why_;
  Probe one(pc(1), 1, "pc1");
  Probe three(pc(3), 3, "pc3");
  ASSERT_TRUE(one.until([&] { return has(one, 3, "pc3 open 10.77.0.3:7000"); }));
  {
    const Inside inside = network_->inside(2);
    MdnsFlood(Network::address(2)).announce_hosts(10'000, 25);
  }
  // Their host ids begin with a zero, of which the probe shows no more.
  EXPECT_TRUE(one.until([&] { return one.count("found 0 flood") > 20; })) << "they arrive";
  one.command("tick");
  EXPECT_TRUE(one.until([&] { return one.count("tock") == 1; }));
  EXPECT_TRUE(has(one, 3, "pc3 open")) << "who was there stays";
  // When Avahi has forgotten them, all is as before, and who comes is found.
  EXPECT_TRUE(one.until_state({"heard=1 "}));
  EXPECT_TRUE(has(one, 3, "pc3 open"));
  EXPECT_LE(one.most_heard(), 257) << "so many are followed, and no more";
  Probe two(pc(2), 2, "pc2");
  EXPECT_TRUE(one.until([&] { return has(one, 2, "pc2 open 10.77.0.2:7000"); }));
}

}  // namespace
}  // namespace dssm::test
