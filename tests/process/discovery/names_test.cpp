// SPDX-License-Identifier: Apache-2.0
//
// Hosts whose names change, and PCs that have each other's.
#include "tests/process/discovery/vehicle.hpp"

namespace dssm::test {
namespace {

using namespace std::chrono_literals;

bool says(const std::string& text, const std::string& part) {
  return text.find(part) != std::string::npos;
}

class Names : public Vehicle {
 protected:
  static HostInfo self(Session& on) { return on.list_hosts().value().at(0); }
  std::string doctor(int pc) {
    return run({built("client/dssmctl/dssmctl"), "doctor"}, {dssmd(pc).environment()}).out;
  }
};

TEST_F(Names, OfAvahiMayChangeAndTheHostStaysTheSameOne) {
  if (!make(2)) GTEST_SKIP() << why_;
  await_all_up();
  const StreamId id{"kept", 0, "pc2"};
  Writer<double> writer = session(2).create<double>("kept", History{16, 10ms}).value();
  writer.write(1);
  Reader<double> reader = session(1).await_reader<double>("kept", deadline_in(1min)).value();
  await("the stream is listed", [&] { return lists(session(1), id); });
  const std::string before = hosts(session(1), "pc2").at(0).id;
  const Finished renamed = run({built("tests/process/discovery/raw-avahi"), "rename", "front-left"},
                               {avahi(2).environment()});
  ASSERT_EQ(renamed.exit_status, 0) << renamed.err;
  EXPECT_EQ(session(1).list_hosts().value().size(), 2u);
  EXPECT_TRUE(is_up(session(1), "pc2"));
  EXPECT_TRUE(lists(session(1), id));
  // And is found by the new name.
  await("all is announced", [&] { return session(2).daemon_info().value().mdns.announced == 2; });
  dssmd(1).kill_hard();
  start_dssmd(1);
  await("pc1 is there again", [&] { return is_up(session(2), "pc1"); });
  await("pc2 is found", [&] { return is_up(session(1), "pc2") && lists(session(1), id); });
  EXPECT_EQ(session(1).list_hosts().value().size(), 2u);
  EXPECT_EQ(hosts(session(1), "pc2").at(0).id, before);
  writer.write(2);
  double value = 0;
  SampleInfo info;
  await("the reader goes on",
        [&] { return reader.read_newest(value, info) == ReadStatus::ok && value == 2; });
}

TEST_F(Names, OfAvahiMayCollide) {
  if (!possible(open_without_avahi(3)) || !possible(name_pc(3, "pc2"))) GTEST_SKIP() << why_;
  network().cut(3);
  for (int pc = 1; pc <= 3; ++pc) start_avahi(pc), add_dssmd();
  await("pc2 is found", [&] { return is_up(session(1), "pc2") && is_up(session(2), "pc1"); });
  await("pc3 has its name", [&] { return session(3).daemon_info().value().mdns.announced == 1; });
  network().heal(3);  // now two PCs are called pc2.local, and one has to change that
  await_all_up();
  for (const int pc : {1, 2, 3}) {
    EXPECT_EQ(session(pc).list_hosts().value().size(), 3u);
    if (pc == 1) continue;
    EXPECT_TRUE(hosts(session(1), Network::name(pc))
                    .at(0)
                    .addresses.at(0)
                    .starts_with(Network::address(pc) + ":"));
  }
}

TEST_F(Names, OfADssmdMayChangeWithItsRestart) {
  if (!make(2)) GTEST_SKIP() << why_;
  await_all_up();
  const StreamId before{"kept", 0, "pc2"}, after{"kept", 0, "pc9"};
  std::optional<Writer<double>> writer =
      session(2).create<double>("kept", History{16, 10ms}).value();
  await("the stream is listed", [&] { return lists(session(1), before); });
  dssmd(2).stop();
  EXPECT_LT(await("the old stream is gone", [&] { return !lists(session(1), before); }), kSoon);
  dssmd(2).call("pc9");
  start_dssmd(2);
  // A ring knows its host: the new one does not take it back, but the program may make another.
  writer.reset();
  await("the program has its dssmd again", [&] {
    if (!writer) {
      if (auto made = session(2).create<double>("kept", History{16, 10ms}))
        writer = *std::move(made);
    }
    return writer.has_value() && writer->id().host == "pc9";
  });
  EXPECT_LT(await("the new one is there", [&] { return lists(session(1), after); }), kSoon);
  EXPECT_FALSE(lists(session(1), before));
  EXPECT_TRUE(is_up(session(1), "pc9"));
  await("the old name is forgotten", [&] { return hosts(session(1), "pc2").empty(); });
  Reader<double> reader = session(1).await_reader<double>("kept", deadline_in(1min)).value();
  writer->write(2);
  double value = 0;
  SampleInfo info;
  await("what is written arrives",
        [&] { return reader.read_newest(value, info) == ReadStatus::ok && value == 2; });
}

// As after the disk of one PC was copied to another: machine id and name are the same. (All PCs of
// a test have this machine's id.)
TEST_F(Names, OfACopiedPcAreReportedOnBothAndFixedByAnotherName) {
  if (!possible(open(2))) GTEST_SKIP() << why_;
  add_dssmd();
  add_dssmd({}, "pc1");
  for (const int pc : {1, 2}) {
    const std::string there = Network::address(3 - pc) + ":";
    await("the copy is noticed", [&] { return says(self(session(pc)).error, there); });
    const std::string warning = self(session(pc)).error;
    EXPECT_TRUE(says(warning, "this host's name 'pc1' and machine id")) << warning;
    const std::vector<HostInfo> all = session(pc).list_hosts().value();
    ASSERT_EQ(all.size(), 2u);
    EXPECT_EQ(all[1].state, HostState::refused);
    EXPECT_EQ(all[1].id, all[0].id);
    EXPECT_EQ(all[1].error, warning);
    const std::string advice = doctor(pc);
    EXPECT_TRUE(says(advice, "FAIL  host pc1: refused: the dssmd at '" + there)) << advice;
    EXPECT_TRUE(says(advice, "sudo rm /etc/machine-id && sudo systemd-machine-id-setup")) << advice;
    EXPECT_TRUE(says(advice, "FAIL  host names: several hosts are called 'pc1'")) << advice;
  }
  dssmd(2).stop();
  dssmd(2).call("pc2");
  start_dssmd(2);
  await_all_up();
  for (const int pc : {1, 2}) {
    await("nothing is wrong any more", [&] {
      return self(session(pc)).error.empty() && session(pc).list_hosts().value().size() == 2;
    });
  }
  EXPECT_FALSE(says(doctor(1), "machine-id"));
}

TEST_F(Names, OfASecondDssmdOfThisPcAreReportedToo) {
  if (!possible(open(1))) GTEST_SKIP() << why_;
  add_dssmd();
  const auto second = make_dssmd(1, "pc1");
  Session on_second = session_of(*second);
  for (Session* on : {&session(1), &on_second}) {
    await("the other is noticed", [&] { return says(self(*on).error, Network::address(1) + ":"); });
  }
}

}  // namespace
}  // namespace dssm::test
