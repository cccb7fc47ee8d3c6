// SPDX-License-Identifier: Apache-2.0
//
// dssmd on several PCs with nothing configured: what mDNS finds, programs see.
#include "tests/process/discovery/vehicle.hpp"

namespace dssm::test {
namespace {

using namespace std::chrono_literals;

TEST_F(Vehicle, ListsEveryStreamOfEveryPcWithNothingConfigured) {
  if (!make(3)) GTEST_SKIP() << why_;
  await_all_up();
  for (int pc = 1; pc <= 3; ++pc) {
    EXPECT_EQ(hosts(session(1), Network::name(pc)).size(), 1u);
  }
  EXPECT_EQ(hosts(session(1), "pc2")[0].found_by, std::vector<std::string>{"mdns"});
  const StreamId lidar{"lidar", 0, "pc2"};
  std::optional<Writer<double>> writer =
      session(2).create<double>("lidar", History{16, 10ms}).value();
  for (const int pc : {1, 3}) {
    EXPECT_LT(await("the new stream is listed", [&] { return lists(session(pc), lidar); }), kSoon);
  }
  writer->write(7);
  Reader<double> reader = session(3).await_reader<double>("lidar", deadline_in(1min)).value();
  double value = 0;
  SampleInfo info;
  EXPECT_EQ(reader.read_newest(value, info), ReadStatus::ok);
  EXPECT_EQ(value, 7);
  session(2).remove(lidar).value();
  for (const int pc : {1, 3}) {
    EXPECT_LT(await("the removed stream is gone", [&] { return !lists(session(pc), lidar); }),
              kSoon);
  }
}

TEST_F(Vehicle, LosesAHostThatStopsAnsweringAndFindsItAgain) {
  if (!make(2)) GTEST_SKIP() << why_;
  await_all_up();
  const StreamId id{"kept", 0, "pc2"};
  Writer<double> writer = session(2).create<double>("kept", History{4096, 1ms}).value();
  writer.write(1);
  Reader<double> reader = session(1).await_reader<double>("kept", deadline_in(1min)).value();
  await("the stream is listed", [&] { return lists(session(1), id); });
  network().cut(2);
  EXPECT_LT(await("the dead host is noticed", [&] { return !is_up(session(1), "pc2"); }), kSoon);
  EXPECT_FALSE(lists(session(1), id));
  writer.write(2);
  network().heal(2);
  EXPECT_LT(await("it is back", [&] { return is_up(session(1), "pc2"); }), kSoon);
  await("its stream is back", [&] { return lists(session(1), id); });
  // The reader goes on by itself.
  double value = 0;
  SampleInfo info;
  await("the sample comes",
        [&] { return reader.read_newest(value, info) == ReadStatus::ok && value == 2; });
  EXPECT_EQ(reader.restarts(), 0u);
}

TEST_F(Vehicle, FindsADssmdThatWasKilledAndOneThatIsNew) {
  if (!make(2)) GTEST_SKIP() << why_;
  await_all_up();
  dssmd(2).kill_hard();
  EXPECT_LT(await("its death is noticed", [&] { return !is_up(session(1), "pc2"); }), kSoon);
  start_dssmd(2);
  await("it is back", [&] { return is_up(session(1), "pc2"); });
}

TEST_F(Vehicle, KeepsItsHostsWhenAvahiDiesAndFindsNewOnesAfterItsRestart) {
  if (!make(3)) GTEST_SKIP() << why_;
  await_all_up();
  for (int pc = 1; pc <= 3; ++pc) avahi(pc).kill_avahi();
  await("the trouble is told",
        [&] { return session(1).daemon_info().value().mdns.phase == MdnsPhase::waiting; });
  EXPECT_NE(session(1).daemon_info().value().mdns.error, "");
  EXPECT_TRUE(is_up(session(1), "pc2")) << "connections are the truth";
  dssmd(3).kill_hard();
  await("its death is noticed", [&] { return !is_up(session(1), "pc3"); });
  start_dssmd(3);
  for (int pc = 1; pc <= 3; ++pc) avahi(pc).start_avahi();
  await_all_up();
  EXPECT_EQ(session(1).daemon_info().value().mdns.phase, MdnsPhase::running);
}

TEST_F(Vehicle, ShowsASecondDssmdOfTheSamePcAsAnotherHost) {
  if (!make(2)) GTEST_SKIP() << why_;
  await_all_up();
  const auto second = make_dssmd(1, "pc1b");
  Session on_second = session_of(*second);
  await("the second is found by the first", [&] { return is_up(session(1), "pc1b"); });
  await("and by the other PC", [&] { return is_up(session(2), "pc1b"); });
  await("and finds both", [&] { return is_up(on_second, "pc1") && is_up(on_second, "pc2"); });
}

TEST_F(Vehicle, ShowsAHostThatListensOnLoopbackOnlyAsClosedAndKeepsItsStreamsOut) {
  if (!make(1)) GTEST_SKIP() << why_;
  const auto closed = make_dssmd(1, "shy", {"--listen", "127.0.0.1:0"});
  Session on_closed = session_of(*closed);
  Writer<double> writer = on_closed.create<double>("secret", History{16, 10ms}).value();
  // On the same PC it can be reached.
  await("it is found", [&] { return is_up(session(1), "shy"); });
  await("its stream is listed", [&] { return lists(session(1), {"secret", 0, "shy"}); });
  await("all of it is announced",
        [&] { return on_closed.daemon_info().value().mdns.announced >= 1; });
  EXPECT_EQ(on_closed.daemon_info().value().mdns.announced, 1u) << "the host, and no stream of it";
}

TEST_F(Vehicle, FollowsAStreamThatMovesUnderARunningReader) {
  if (!make(3)) GTEST_SKIP() << why_;
  await_all_up();
  std::optional<Writer<double>> writer =
      session(2).create<double>("moving", History{64, 1ms}).value();
  writer->write(1);
  Reader<double> reader = session(1).await_reader<double>("moving", deadline_in(1min)).value();
  double value = 0;
  SampleInfo info;
  EXPECT_EQ(reader.read_newest(value, info), ReadStatus::ok);
  session(2).remove({"moving", 0, "pc2"}).value();
  writer = session(3).create<double>("moving", History{64, 1ms}).value();
  writer->write(2);
  await("the reader goes on at the other host",
        [&] { return reader.read_newest(value, info) == ReadStatus::ok && value == 2; });
  EXPECT_EQ(reader.restarts(), 1u);
}

}  // namespace
}  // namespace dssm::test
