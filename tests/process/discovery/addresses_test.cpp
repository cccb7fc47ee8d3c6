// SPDX-License-Identifier: Apache-2.0
//
// Hosts whose ways to each other change: interfaces that come and go, several to one host, other
// addresses, none but link-local ones, and firewalls that swallow.
#include "tests/process/discovery/vehicle.hpp"

namespace dssm::test {
namespace {

using namespace std::chrono_literals;

using Flags = std::vector<std::string>;

// For what waits for Avahi: it claims an address for about 1 s before it announces it, and drops an
// old one 1 s after that; a lost packet costs a second more.
constexpr Duration kWhenAvahiKnows = kSoon + 6s;

// At whatever addresses the PC has by and by.
const Flags kEverywhere{"--listen", "0.0.0.0:13776", "--listen", "[::]:13776", "--insecure"};

class Addresses : public Vehicle {
 protected:
  // pc2 has a stream, which a program on pc1 reads.
  void share() {
    await_all_up();
    writer_ = session(2).create<double>("kept", History{4096, 1ms}).value();
    writer_->write(0);
    reader_ = session(1).await_reader<double>("kept", deadline_in(1min)).value();
    await("the stream is listed", [&] { return lists(session(1), kKept); });
  }
  // What is written now arrives, without that the reader does anything for it.
  void expect_that_the_reader_follows() {
    writer_->write(++written_);
    double value = 0;
    SampleInfo info;
    await("the reader goes on",
          [&] { return reader_->read_newest(value, info) == ReadStatus::ok && value == written_; });
    EXPECT_EQ(reader_->restarts(), 0u);
  }
  Duration await_gone(const std::string& why) {
    const Duration took = await("pc2 is gone: " + why, [&] { return !is_up(session(1), "pc2"); });
    EXPECT_FALSE(lists(session(1), kKept));
    return took;
  }
  Duration await_back(const std::string& why) {
    return await("pc2 is back: " + why,
                 [&] { return is_up(session(1), "pc2") && lists(session(1), kKept); });
  }
  void plug_in_eth0() {
    network().add_cable(2, "eth0");
    network().configure(2, "address add " + Network::address(2) + "/24 dev eth0\n" +  //
                               "address add " + Network::address6(2) + "/64 dev eth0 nodad\n");
  }
  void expect_that_eth0_may_go_and_come() {
    share();
    network().configure(2, "link del eth0\n");
    EXPECT_LT(await_gone("its interface is deleted"), kSoon);
    await("pc2 has lost pc1", [&] { return !is_up(session(2), "pc1"); });
    plug_in_eth0();
    EXPECT_LT(await_back("its interface is there again"), kSoon);
    await("pc2 has found pc1", [&] { return is_up(session(2), "pc1"); });
    expect_that_the_reader_follows();
  }
  // Where pc1 talks to pc2.
  std::string address_in_use() { return hosts(session(1), "pc2").at(0).addresses.at(0); }

  const StreamId kKept{"kept", 0, "pc2"};
  std::optional<Writer<double>> writer_;
  std::optional<Reader<double>> reader_;
  double written_ = 0;
};

TEST_F(Addresses, MakeOneHostOfAPcWithCableAndWifiAndOneOfThemIsEnough) {
  if (!possible(open_without_avahi(2))) GTEST_SKIP() << why_;
  const auto addresses_of = [](const std::string& interface) -> std::string {
    return interface == "eth0" ? "address add 10.77.0.2/24 dev eth0\n"
                                 "address add fd77::2/64 dev eth0 nodad\n"
                               : "address add 10.77.0.102/24 dev wlan0\n"
                                 "address add fd77::102/64 dev wlan0 nodad\n";
  };
  network().add_cable(2, "wlan0");
  network().configure(2, addresses_of("wlan0"));
  for (int pc = 1; pc <= 2; ++pc) start_avahi(pc), add_dssmd(kEverywhere);
  share();
  for (const int pc : {1, 2}) {
    EXPECT_EQ(session(pc).list_hosts().value().size(), 2u) << "the other one, and itself";
    EXPECT_EQ(session(pc).list_streams().value().size(), 1u);
  }
  // Whichever has the address in use goes; when it is back the other one goes.
  for (int turn = 0; turn < 4; ++turn) {
    const std::string used = address_in_use();
    const std::string interface =
        used.starts_with("10.77.0.102") || used.starts_with("[fd77::102") ? "wlan0" : "eth0";
    std::printf("in use: %s\n", used.c_str());
    // What a PC's network manager does when the cable is out. The kernel alone would keep the
    // address, and answer for it on the other interface.
    network().configure(2,
                        "address flush dev " + interface + "\nlink set " + interface + " down\n");
    // It is gone for some 50 ms only, which nobody needs to see.
    EXPECT_LT(await("pc2 is there by the other interface",
                    [&] {
                      const std::vector<HostInfo> now = hosts(session(1), "pc2");
                      return now.size() == 1 && now[0].state == HostState::up &&
                             now[0].addresses.at(0) != used && lists(session(1), kKept);
                    }),
              kWhenAvahiKnows);
    expect_that_the_reader_follows();
    network().configure(2, "link set " + interface + " up\n" + addresses_of(interface));
    EXPECT_EQ(session(1).list_hosts().value().size(), 2u);
  }
}

TEST_F(Addresses, LoseAndFindAHostWhoseInterfaceIsRecreated) {
  if (!make(2, kEverywhere)) GTEST_SKIP() << why_;
  expect_that_eth0_may_go_and_come();
}

TEST_F(Addresses, LoseAndFindAHostWhoseChosenInterfaceIsRecreated) {
  Flags flags = kEverywhere;
  flags.insert(flags.end(), {"--interface", "eth*"});
  if (!make(2, flags)) GTEST_SKIP() << why_;
  expect_that_eth0_may_go_and_come();
}

TEST_F(Addresses, FindAHostOnAnInterfaceThatIsAddedLater) {
  if (!possible(open_without_avahi(2))) GTEST_SKIP() << why_;
  network().configure(2, "link del eth0\n");
  for (int pc = 1; pc <= 2; ++pc) start_avahi(pc), add_dssmd(kEverywhere);
  for (int pc = 1; pc <= 2; ++pc) {
    await("Avahi is used", [&] { return session(pc).daemon_info().value().mdns.own_host_seen; });
  }
  plug_in_eth0();
  EXPECT_LT(await("pc1 has found pc2", [&] { return is_up(session(1), "pc2"); }), kWhenAvahiKnows);
  EXPECT_LT(await("pc2 has found pc1", [&] { return is_up(session(2), "pc1"); }), kWhenAvahiKnows);
}

TEST_F(Addresses, MayBeLinkLocalOnesOnly) {
  if (!possible(open_without_avahi(2))) GTEST_SKIP() << why_;
  for (int pc = 1; pc <= 2; ++pc) {
    network().configure(pc, "address flush dev eth0 scope global\n");
    start_avahi(pc), add_dssmd(kEverywhere);
  }
  share();
  EXPECT_TRUE(address_in_use().starts_with("[fe80::")) << address_in_use();
  EXPECT_NE(address_in_use().find("%eth0]:13776"), std::string::npos) << address_in_use();
  expect_that_the_reader_follows();
  network().cut(2);
  EXPECT_LT(await_gone("the cable is out"), kSoon);
  network().heal(2);
  EXPECT_LT(await_back("the cable is in"), kSoon);
  expect_that_the_reader_follows();
}

TEST_F(Addresses, MayBeChangedByDhcpOnEitherSide) {
  if (!possible(open_without_avahi(2))) GTEST_SKIP() << why_;
  for (int pc = 1; pc <= 2; ++pc) {
    // No IPv6, which would be there all the while.
    network().configure(pc,
                        "link set eth0 addrgenmode none\n"
                        "address flush dev eth0\n"
                        "address add " +
                            Network::address(pc) + "/24 dev eth0\n");
    start_avahi(pc), add_dssmd(kEverywhere);
  }
  share();
  for (const int pc : {2, 1}) {
    const std::string old = Network::address(pc), fresh = "10.77.0.7" + std::to_string(pc);
    network().configure(pc, "address del " + old + "/24 dev eth0\n" +  //
                                "address add " + fresh + "/24 dev eth0\n");
    const int other = 3 - pc;
    EXPECT_LT(await("it is up at its new address",
                    [&] {
                      const auto found = hosts(session(other), Network::name(pc));
                      return found.size() == 1 && found[0].state == HostState::up &&
                             found[0].addresses.at(0) == fresh + ":13776";
                    }),
              kWhenAvahiKnows);
    await("the other direction works", [&] { return is_up(session(pc), Network::name(other)); });
    await_back("with its stream");
    expect_that_the_reader_follows();
  }
}

TEST_F(Addresses, MaySwallowForAWhileWhatIsSentToThem) {
  if (!make(2, kEverywhere)) GTEST_SKIP() << why_;
  share();
  for (int round = 0; round < 3; ++round) {
    if (!possible(network().swallow(2))) GTEST_SKIP() << why_;
    EXPECT_LT(await_gone("it swallows"), kSoon);
    // Attempts are under way, which nobody answers.
    await("it was tried", [&] {
      const std::vector<HostInfo> found = hosts(session(1), "pc2");
      return found.size() == 1 && found[0].error.find("no answer") != std::string::npos;
    });
    network().stop_swallowing(2);
    EXPECT_LT(await_back("it answers"), kSoon);
    expect_that_the_reader_follows();
  }
}

}  // namespace
}  // namespace dssm::test
