// SPDX-License-Identifier: Apache-2.0
//
// One name space over three dssmd: what is listed and watched, which stream a name means, and what
// may be asked about streams of other hosts.
#include <gtest/gtest.h>
#include <signal.h>

#include <condition_variable>
#include <mutex>

#include "tests/process/fleet/fleet_tools.hpp"

namespace dssm::test {
namespace {

using namespace std::chrono_literals;
using Strings = std::vector<std::string>;

// pc1 knows pc2 and pc3; they know nobody.
class FleetCatalog : public testing::Test {
 protected:
  DaemonProcess pc2{{}, "pc2"}, pc3{{}, "pc3"};
  DaemonProcess pc1{{"--peer", pc2.address(), "--peer", pc3.address()}};
  Session on1 = connect(pc1), on2 = connect(pc2), on3 = connect(pc3);

  FleetCatalog() {
    await_state(on1, pc2, HostState::up);
    await_state(on1, pc3, HostState::up);
  }
};

TEST_F(FleetCatalog, ListsOwnStreamsThenThoseOfTheOthers) {
  auto three = on3.create<double>("imu", kHistory).value();
  auto two = on2.create<double>("lidar", kHistory).value();
  auto second = on2.create<double>("camera", kHistory).value();
  auto one = on1.create<double>("odometry", kHistory).value();
  for (int i = 0; i < 5; ++i) two.write(1.5, time_from_ns(1000 + i));
  await_list(on1, {"odometry:0@pc1", "lidar:0@pc2", "camera:0@pc2", "imu:0@pc3"});
  EXPECT_EQ(names(on1.list_own_streams().value()), Strings{"odometry:0@pc1"});
  EXPECT_EQ(names(on2.list_streams().value()), (Strings{"lidar:0@pc2", "camera:0@pc2"}));
  const StreamInfo lidar = on1.list_streams().value().at(1);
  EXPECT_EQ(lidar.newest, 4);
  EXPECT_EQ(to_ns(lidar.newest_time), 1004) << "as fresh as at its owner's";
  EXPECT_EQ(lidar.type, type_of<double>());
  EXPECT_EQ(lidar.writers, 1u);
}

TEST_F(FleetCatalog, IsAnsweredWithWhatIsKnownWhenAHostHangs) {
  auto two = on2.create<double>("lidar", kHistory).value();
  auto three = on3.create<double>("imu", kHistory).value();
  await_list(on1, {"lidar:0@pc2", "imu:0@pc3"});
  ::kill(pc2.pid(), SIGSTOP);
  EXPECT_EQ(names(on1.list_streams().value()), (Strings{"lidar:0@pc2", "imu:0@pc3"}));
  await_state(on1, pc2, HostState::down);
  EXPECT_EQ(names(on1.list_streams().value()), Strings{"imu:0@pc3"});
  ::kill(pc2.pid(), SIGCONT);
  await_list(on1, {"lidar:0@pc2", "imu:0@pc3"});
}

TEST_F(FleetCatalog, NotifiesWatchersOfAddedAndRemovedStreamsOfAllHosts) {
  std::mutex mutex;
  std::condition_variable changed;
  Strings seen;
  auto two = on2.create<double>("lidar", kHistory).value();
  await_list(on1, {"lidar:0@pc2"});
  auto watch = on1.watch([&](const StreamEvent& event) {
    const std::lock_guard guard(mutex);
    seen.push_back((event.kind == StreamEvent::Kind::added ? "+" : "-") + event.stream.id.str());
    changed.notify_all();
  });
  ASSERT_TRUE(watch);
  const auto wait_for_seen = [&](const Strings& expected) {
    std::unique_lock lock(mutex);
    changed.wait(lock, [&] { return seen.size() >= expected.size(); });
    EXPECT_EQ(std::exchange(seen, {}), expected);
  };
  wait_for_seen({"+lidar:0@pc2"});
  auto three = on3.create<double>("imu", kHistory).value();
  wait_for_seen({"+imu:0@pc3"});
  ASSERT_TRUE(on2.remove({"lidar", 0, ""}));
  wait_for_seen({"-lidar:0@pc2"});
  pc3.kill_hard();
  wait_for_seen({"-imu:0@pc3"});
  pc3.start();  // and the program there gives its stream back
  wait_for_seen({"+imu:0@pc3"});
}

TEST_F(FleetCatalog, NotifiesWatchersOfPropertiesOnOtherHosts) {
  auto two = on2.create<double>("lidar", kHistory).value();
  await_list(on1, {"lidar:0@pc2"});
  SeenEvents watched(on1);
  for (int i = 0; i < 3; ++i) two.write(i);
  const std::byte property[] = {std::byte{1}, std::byte{2}};
  ASSERT_TRUE(two.set_property(property));
  const std::vector<StreamEvent> seen = watched.await(2);
  EXPECT_FALSE(seen[0].property_set);
  EXPECT_TRUE(seen[1].property_set);
  EXPECT_EQ(seen[1].stream.id.str(), "lidar:0@pc2");
  EXPECT_EQ(seen[1].stream.incarnation, two.incarnation());
  EXPECT_EQ(seen[1].stream.newest, 2);
  EXPECT_EQ(seen[1].stream.property_bytes, 2U);
}

TEST_F(FleetCatalog, OpensWhatANameMeans) {
  auto two = on2.create<double>("lidar", kHistory).value();
  two.write(2);
  const auto value = [&](const std::string& name) -> double {
    Reader<double> reader = on1.await_reader<double>(name).value();
    double sample = 0;
    SampleInfo info;
    await([&] { return reader.read_newest(sample, info) == ReadStatus::ok; });
    return sample;
  };
  EXPECT_EQ(value("lidar"), 2) << "the only one there is";
  EXPECT_EQ(value("lidar@pc2"), 2);

  auto three = on3.create<double>("lidar", kHistory).value();
  three.write(3);
  await([&] { return on1.list_streams().value().size() == 2; });
  const auto both = on1.open_reader<double>("lidar");
  ASSERT_FALSE(both);
  EXPECT_EQ(both.error().code, Errc::conflict);
  EXPECT_NE(both.error().message.find("'pc2'"), std::string::npos) << both.error().message;
  EXPECT_NE(both.error().message.find("'pc3'"), std::string::npos) << both.error().message;
  EXPECT_EQ(value("lidar@pc3"), 3);

  auto one = on1.create<double>("lidar", kHistory).value();  // here, whoever else has one
  one.write(1);
  EXPECT_EQ(value("lidar"), 1) << "the own one comes first";
  EXPECT_EQ(value("lidar@pc2"), 2);
}

TEST_F(FleetCatalog, ReportsWhereItSearchedAndWhichHostsDoNotAnswer) {
  auto nowhere = on1.open_reader<double>("gps");
  ASSERT_FALSE(nowhere);
  EXPECT_EQ(nowhere.error().code, Errc::not_found);
  EXPECT_NE(nowhere.error().message.find("'pc2', 'pc3'"), std::string::npos)
      << nowhere.error().message;
  pc3.kill_hard();
  await_state(on1, pc3, HostState::down);
  nowhere = on1.open_reader<double>("gps");
  EXPECT_NE(nowhere.error().message.find("not answering at the moment: '" + pc3.address()),
            std::string::npos)
      << nowhere.error().message;
  const auto unknown = on1.open_reader<double>("gps@pc9");
  ASSERT_FALSE(unknown);
  EXPECT_EQ(unknown.error().code, Errc::not_found);
  EXPECT_NE(unknown.error().message.find("no host 'pc9'"), std::string::npos);
  const auto there = on1.open_reader<double>("gps@pc2");
  ASSERT_FALSE(there);
  EXPECT_EQ(there.error().code, Errc::not_found);
}

TEST_F(FleetCatalog, CarriesPropertiesInfoAndRemoval) {
  auto two = on2.create<double>("lidar", kHistory).value();
  await_list(on1, {"lidar:0@pc2"});
  const StreamId any{"lidar", 0, ""}, there{"lidar", 0, "pc2"};
  const auto none = on1.property(any);
  ASSERT_FALSE(none);
  EXPECT_EQ(none.error().code, Errc::not_found);
  const std::vector<std::byte> pose(100'000, std::byte{7});
  ASSERT_TRUE(on1.set_property(any, pose));
  EXPECT_EQ(on2.property(any).value(), pose);
  EXPECT_EQ(on1.property(there).value(), pose);
  // The largest there may be crosses as well, and does not cost the connection.
  const std::vector<std::byte> large(1U << 20, std::byte{9});
  ASSERT_TRUE(on1.set_property(there, large));
  EXPECT_EQ(on1.property(there).value(), large);
  EXPECT_EQ(peer_at(on1, pc2.address()).state, HostState::up);

  const StreamInfo info = on1.stream_info(any).value();
  EXPECT_EQ(info.id, there);
  EXPECT_EQ(info.property_bytes, large.size());
  ASSERT_EQ(info.users.size(), 1u);
  EXPECT_EQ(info.users[0].role, Role::writer);
  EXPECT_FALSE(info.mirror) << "nobody reads it here";
  {
    Reader<double> reader = on1.open_reader<double>("lidar").value();
    two.write(1);
    await([&] { return reader.newest_tid() == 0; });
    const StreamInfo read = on1.stream_info(any).value();
    ASSERT_TRUE(read.mirror);
    EXPECT_EQ(read.mirror->state, MirrorState::live);
    EXPECT_EQ(read.mirror->newest, 0);
    EXPECT_EQ(read.channels, 1u);
  }
  ASSERT_TRUE(on1.remove(any));
  EXPECT_TRUE(on2.list_streams().value().empty());
  await_list(on1, {});
  const auto gone = on1.stream_info(there);
  ASSERT_FALSE(gone) << "not even while its mirror lingers";
  EXPECT_EQ(gone.error().code, Errc::not_found);
  EXPECT_FALSE(on1.open_reader<double>("lidar"));
}

TEST_F(FleetCatalog, AnswersPingsOfHostsByName) {
  const RoundTrip answer = on1.ping("pc2").value();
  EXPECT_GT(answer.round_trip, 0ns);
  EXPECT_EQ(answer.address, pc2.address());
  EXPECT_TRUE(on1.ping("pc1")) << "oneself";
  const auto unknown = on1.ping("pc9");
  ASSERT_FALSE(unknown);
  EXPECT_EQ(unknown.error().code, Errc::not_found);
  ::kill(pc2.pid(), SIGSTOP);
  const auto hanging = on1.ping("pc2");
  ASSERT_FALSE(hanging);
  EXPECT_EQ(hanging.error().code, Errc::unavailable) << hanging.error().message;
  ::kill(pc2.pid(), SIGCONT);
}

TEST_F(FleetCatalog, LetsReadersFollowAStreamThatMoves) {
  auto two = on2.create<double>("lidar", kHistory).value();
  two.write(2);
  Reader<double> reader = on1.await_reader<double>("lidar").value();
  Reader<double> particular = on1.open_reader<double>("lidar@pc2").value();
  double sample = 0;
  SampleInfo info;
  const auto await_value = [&](double value) {
    await([&] { return reader.read_newest(sample, info) == ReadStatus::ok && sample == value; });
  };
  await_value(2);
  ASSERT_TRUE(on2.remove({"lidar", 0, ""}));
  await_list(on1, {});
  auto three = on3.create<double>("lidar", kHistory).value();
  three.write(3);
  await_value(3);
  // The next one is there before the old one goes.
  auto two_again = on2.create<double>("lidar", kHistory).value();
  two_again.write(22);
  await_list(on1, {"lidar:0@pc2", "lidar:0@pc3"});
  EXPECT_EQ(particular.restarts(), 0u);
  await([&] { return particular.read_newest(sample, info) == ReadStatus::ok && sample == 22; });
  pc3.kill_hard();
  await_value(22);
  auto one = on1.create<double>("lidar", kHistory).value();
  one.write(1);
  ASSERT_TRUE(on2.remove({"lidar", 0, ""}));
  await_value(1);
  EXPECT_EQ(reader.restarts(), 3u);
  EXPECT_EQ(particular.restarts(), 1u) << "only when its own host had a new ring";
}

// Its history is here, and goes on being here while its owner is away.
TEST_F(FleetCatalog, KeepsTheMirrorOfAnUnavailableOwner) {
  {
    auto two = on2.create<double>("lidar", kHistory).value();
    two.write(2);
  }
  Reader<double> reader = on1.await_reader<double>("lidar").value();
  await([&] { return reader.newest_tid() == 0; });
  pc2.kill_hard();
  await_state(on1, pc2, HostState::down);
  for (const std::string name : {"lidar", "lidar@pc2"}) {
    const auto another = on1.open_reader<double>(name);
    ASSERT_TRUE(another) << another.error().message;
    EXPECT_EQ(another->newest_tid(), 0);
    const StreamInfo info = on1.stream_info(StreamId::parse(name).value()).value();
    ASSERT_TRUE(info.mirror);
    EXPECT_NE(info.mirror->error, "");
    EXPECT_EQ(info.newest, 0);
  }
  EXPECT_TRUE(on1.list_streams().value().empty()) << "it is not to be had anew";
}

// Programs that start together with dssmd find what other hosts have.
TEST_F(FleetCatalog, IsThereForTheFirstRequest) {
  auto two = on2.create<double>("lidar", kHistory).value();
  for (int round = 0; round < 5; ++round) {
    DaemonProcess fresh({"--peer", pc2.address()}, "pc4");
    Session session = connect(fresh);
    const auto reader = session.open_reader<double>(round % 2 ? "lidar" : "lidar@pc2");
    ASSERT_TRUE(reader) << reader.error().message;
  }
}

}  // namespace
}  // namespace dssm::test
