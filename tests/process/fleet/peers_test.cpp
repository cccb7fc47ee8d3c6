// SPDX-License-Identifier: Apache-2.0
//
// Peers that come, go, hang, come back, answer at two addresses, or are oneself.
#include <arpa/inet.h>
#include <gtest/gtest.h>
#include <signal.h>
#include <sys/socket.h>

#include "core/base/unique_fd.hpp"
#include "tests/process/fleet/fleet_tools.hpp"
#include "tests/support/authority.hpp"

namespace dssm::test {
namespace {

using namespace std::chrono_literals;

// An address that nobody listens at, until somebody does.
std::string free_address() {
  const UniqueFd socket(::socket(AF_INET, SOCK_STREAM | SOCK_CLOEXEC, 0));
  sockaddr_in address{};
  address.sin_family = AF_INET;
  address.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
  socklen_t length = sizeof address;
  EXPECT_EQ(::bind(socket.get(), reinterpret_cast<sockaddr*>(&address), length), 0);
  EXPECT_EQ(::getsockname(socket.get(), reinterpret_cast<sockaddr*>(&address), &length), 0);
  return "127.0.0.1:" + std::to_string(ntohs(address.sin_port));
}

TEST(FleetPeers, ShowThemselvesWithVersionAndRoundTrip) {
  const DaemonProcess pc2({}, "pc2");
  const DaemonProcess pc1({"--peer", pc2.address()});
  Session session = connect(pc1);
  await([&] { return peer_at(session, pc2.address()).round_trip > 0ns; });
  const std::vector<HostInfo> hosts = session.list_hosts().value();
  ASSERT_EQ(hosts.size(), 2u);
  EXPECT_EQ(hosts[0].name, "pc1");
  EXPECT_EQ(hosts[0].state, HostState::self);
  EXPECT_EQ(hosts[0].addresses, pc1.addresses());
  EXPECT_EQ(hosts[0].error, "");
  EXPECT_EQ(hosts[1].name, "pc2");
  EXPECT_EQ(hosts[1].state, HostState::up);
  EXPECT_EQ(hosts[1].addresses, std::vector{pc2.address()});
  EXPECT_EQ(hosts[1].version, hosts[0].version);
  EXPECT_LE(hosts[1].min_round_trip, hosts[1].round_trip);
  EXPECT_FALSE(hosts[1].insecure) << "it does not leave this PC";
  EXPECT_EQ(hosts[1].error, "");
}

TEST(FleetPeers, AreDownWhenKilledAndComeBackByThemselves) {
  DaemonProcess pc2({}, "pc2");
  const DaemonProcess pc1({"--peer", pc2.address()});
  Session on1 = connect(pc1), on2 = connect(pc2);
  auto kept = on2.create<double>("kept", kHistory).value();
  const std::uint64_t incarnation = kept.incarnation();
  for (int round = 0; round < 3; ++round) {
    await_list(on1, {"kept:0@pc2"});
    EXPECT_EQ(on1.list_streams().value()[0].incarnation, incarnation) << "given back by its writer";
    pc2.kill_hard();
    await_state(on1, pc2, HostState::down);
    EXPECT_TRUE(on1.list_streams().value().empty());
    const HostInfo down = peer_at(on1, pc2.address());
    EXPECT_EQ(down.name, "pc2") << "who it was";
    EXPECT_NE(down.error, "");
    pc2.start();
  }
}

TEST(FleetPeers, AreDownWhileTheyHangAndUpAfterwards) {
  DaemonProcess pc2({}, "pc2");
  const DaemonProcess pc1({"--peer", pc2.address()});
  Session on1 = connect(pc1), on2 = connect(pc2);
  auto kept = on2.create<double>("kept", kHistory).value();
  await_list(on1, {"kept:0@pc2"});
  ::kill(pc2.pid(), SIGSTOP);
  await_state(on1, pc2, HostState::down);
  EXPECT_NE(peer_at(on1, pc2.address()).error, "");
  EXPECT_TRUE(on1.list_streams().value().empty());
  ::kill(pc2.pid(), SIGCONT);
  await_list(on1, {"kept:0@pc2"});
}

// As where the clock of a PC is behind until chronyd sets it right.
TEST(FleetPeers, AreUpOnceTheirCertificatesAreValidByTheClock) {
  const std::filesystem::path folder = make_temp_dir();
  Authority authority;
  Authority::Subject later = Authority::host("pc2");
  later.valid_from = 4s;
  const Time valid = WallClock::now() + 3s;  // certificates have whole seconds
  authority.issue(later, folder / "pc2");
  authority.issue(Authority::host("pc1"), folder / "pc1");
  {
    const DaemonProcess pc2({"--credentials", folder / "pc2"}, "pc2");
    const DaemonProcess pc1({"--credentials", folder / "pc1", "--peer", pc2.address()});
    Session session = connect(pc1);
    await_state(session, pc2, HostState::up);
    EXPECT_GE(WallClock::now(), valid);
  }
  remove_tree(folder);
}

TEST(FleetPeers, MayStartLater) {
  const std::string address = free_address();
  const DaemonProcess pc1({"--peer", address});
  Session on1 = connect(pc1);
  await([&] { return peer_at(on1, address).state == HostState::down; });
  EXPECT_EQ(peer_at(on1, address).name, "");
  EXPECT_NE(peer_at(on1, address).error.find(address), std::string::npos);
  const DaemonProcess pc2({"--listen", address}, "pc2");
  await([&] { return peer_at(on1, address).state == HostState::up; });
  EXPECT_EQ(peer_at(on1, address).name, "pc2");
}

TEST(FleetPeers, KnowEachOther) {
  const std::string at1 = free_address(), at2 = free_address();
  const DaemonProcess pc1({"--listen", at1, "--peer", at2});
  const DaemonProcess pc2({"--listen", at2, "--peer", at1}, "pc2");
  Session on1 = connect(pc1), on2 = connect(pc2);
  auto one = on1.create<double>("one", kHistory).value();
  auto two = on2.create<double>("two", kHistory).value();
  await_list(on1, {"one:0@pc1", "two:0@pc2"});
  await_list(on2, {"two:0@pc2", "one:0@pc1"});
}

TEST(FleetPeers, MayBeOneself) {
  const std::string address = free_address();
  const DaemonProcess pc1({"--listen", address, "--peer", address});
  Session session = connect(pc1);
  auto writer = session.create<double>("lidar", kHistory).value();
  await([&] { return session.list_hosts().value()[1].state == HostState::self; });
  EXPECT_EQ(names(session.list_streams().value()), std::vector<std::string>{"lidar:0@pc1"});
  EXPECT_EQ(session.list_hosts().value()[0].error, "");
}

TEST(FleetPeers, AreOneHostAtTwoAddresses) {
  const DaemonProcess pc2({"--listen", "127.0.0.1:0", "--listen", "127.0.0.2:0"}, "pc2");
  ASSERT_EQ(pc2.addresses().size(), 2u);
  const DaemonProcess pc1({"--peer", pc2.addresses()[0], "--peer", pc2.addresses()[1]});
  Session on1 = connect(pc1), on2 = connect(pc2);
  auto writer = on2.create<double>("lidar", kHistory).value();
  await_list(on1, {"lidar:0@pc2"});
  const auto first = [&] { return peer_at(on1, pc2.addresses()[0]); };
  const auto second = [&] { return peer_at(on1, pc2.addresses()[1]); };
  await([&] { return first().state == HostState::up && second().state == HostState::up; });
  // Not at once: the connection that was there later may take over meanwhile.
  await([&] { return first().streams + second().streams == 1u; });
  EXPECT_NE((first().error + second().error).find("same host as '127.0.0."), std::string::npos);
  EXPECT_TRUE(on1.open_reader<double>("lidar@pc2"));
}

TEST(FleetPeers, WithTheSameNameAreWarnedOf) {
  const DaemonProcess pc2({}, "pc2"), other({}, "pc2"), namesake({}, "pc1");
  const DaemonProcess pc1(
      {"--peer", pc2.address(), "--peer", other.address(), "--peer", namesake.address()});
  Session on1 = connect(pc1);
  await([&] {
    return peer_at(on1, pc2.address()).error + peer_at(on1, other.address()).error != "";
  });
  await([&] { return peer_at(on1, namesake.address()).state == HostState::refused; });
  EXPECT_NE(peer_at(on1, namesake.address()).error.find("this host's name 'pc1'"),
            std::string::npos)
      << peer_at(on1, namesake.address()).error;
  EXPECT_EQ(on1.list_hosts().value()[0].error, peer_at(on1, namesake.address()).error);
}

}  // namespace
}  // namespace dssm::test
