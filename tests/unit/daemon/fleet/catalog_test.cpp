// SPDX-License-Identifier: Apache-2.0
//
// The catalog's rules: identity by id, names that collide, restarts, order of what is told, and
// bounds.
#include "daemon/fleet/catalog.hpp"

#include <gtest/gtest.h>

#include "tests/unit/daemon/daemon_fixtures.hpp"

namespace dssm::daemon {
namespace {

wire::Greeting host(const std::string& name, std::uint8_t id, std::uint64_t instance_id = 1) {
  wire::Greeting greeting;
  greeting.host = name;
  greeting.host_id[0] = id;
  greeting.instance_id = instance_id;
  return greeting;
}

wire::Address at(const std::string& address) { return {address, 13776}; }

wire::HostId id_of(std::uint8_t id) { return host("", id).host_id; }

StreamInfo stream(const std::string& name, const std::string& owner,
                  std::uint64_t incarnation = 1) {
  StreamInfo info;
  info.id = {name, 0, owner};
  info.type = odometry_type();
  info.incarnation = incarnation;
  return info;
}

// Writes down what it is told.
class Recorder final : public CatalogObserver {
 public:
  void on_host_up(const KnownHost& known) override {
    events.push_back("up " + known.greeting.host);
  }
  void on_host_down(const KnownHost& known, const Error& why) override {
    events.push_back("down " + known.greeting.host + ": " + why.message);
  }
  void on_remote_stream_added(const KnownHost&, const StreamInfo& info) override {
    events.push_back("+" + info.id.str());
  }
  void on_remote_property_set(const StreamInfo& info) override {
    events.push_back(info.id.str() + " property after " + std::to_string(info.newest));
  }
  void on_remote_stream_removed(const KnownHost&, const StreamInfo& info) override {
    events.push_back("-" + info.id.str());
  }
  std::vector<std::string> take() { return std::exchange(events, {}); }
  std::vector<std::string> events;
};

using Told = std::vector<std::string>;

TEST(Catalog, DoesNotKeepWhatChangesWithEachSample) {
  Catalog catalog("pc1");
  catalog.host_up(host("pc2", 2), at("10.0.0.2"));
  StreamInfo info = stream("lidar", "pc2");
  info.oldest = info.newest = 3;
  info.rate_hz = 40;
  info.state = StreamState::live;
  ASSERT_TRUE(catalog.stream_added(id_of(2), info));
  const StreamInfo& kept = catalog.hosts().begin()->second.streams.begin()->second;
  EXPECT_EQ(kept.oldest, kNoTid);
  EXPECT_EQ(kept.newest, kNoTid);
  EXPECT_EQ(kept.rate_hz, 0);
  EXPECT_EQ(kept.state, StreamState::unknown);
}

TEST(Catalog, ReportsAdditionsAndRemovalsInOrder) {
  Catalog catalog("pc1");
  Recorder recorder;
  catalog.add_observer(recorder);
  catalog.host_up(host("pc2", 2), at("10.0.0.2"));
  ASSERT_TRUE(catalog.stream_added(id_of(2), stream("lidar", "pc2")));
  ASSERT_TRUE(catalog.stream_added(id_of(2), stream("imu", "pc2")));
  EXPECT_EQ(recorder.take(), (Told{"up pc2", "+lidar:0@pc2", "+imu:0@pc2"}));
  catalog.stream_removed(id_of(2), {"imu", 0, "pc2"});
  catalog.stream_removed(id_of(2), {"imu", 0, "pc2"});
  EXPECT_EQ(recorder.take(), Told{"-imu:0@pc2"});
  catalog.host_down(id_of(2), {Errc::unavailable, "cut"});
  catalog.host_down(id_of(2), {Errc::unavailable, "cut"});
  EXPECT_EQ(recorder.take(), (Told{"down pc2: cut", "-lidar:0@pc2"}));
  EXPECT_TRUE(catalog.hosts().empty());
  catalog.remove_observer(recorder);
  catalog.host_up(host("pc2", 2), at("10.0.0.2"));
  EXPECT_TRUE(recorder.events.empty());
}

TEST(Catalog, ReportsManyStreamsOfAHostThatIsDownInTurns) {
  constexpr int kStreams = 2 * Catalog::kRemovedPerTurn + 1;
  Catalog catalog("pc1");
  Recorder recorder;
  catalog.host_up(host("pc2", 2), at("10.0.0.2"));
  for (int i = 0; i < kStreams; ++i) {
    ASSERT_TRUE(catalog.stream_added(id_of(2), stream("s" + std::to_string(10'000 + i), "pc2")));
  }
  catalog.add_observer(recorder);
  catalog.host_down(id_of(2), {Errc::unavailable, "cut"});
  EXPECT_TRUE(catalog.hosts().empty());
  EXPECT_EQ(recorder.take().size(), 1u + Catalog::kRemovedPerTurn);
  // It is up again, with one of those that are left.
  const std::string last = "s" + std::to_string(10'000 + kStreams - 1);
  catalog.host_up(host("pc2", 2, 2), at("10.0.0.2"));
  ASSERT_TRUE(catalog.stream_added(id_of(2), stream(last, "pc2", 2)));
  EXPECT_EQ(recorder.take(), (Told{"up pc2", "+" + last + ":0@pc2"}));
  EXPECT_TRUE(catalog.report_removed());
  EXPECT_EQ(recorder.take().size(), std::size_t{Catalog::kRemovedPerTurn});
  EXPECT_FALSE(catalog.report_removed());
  EXPECT_EQ(recorder.take(), Told{}) << "it is there";
}

TEST(Catalog, ReportsANewRingAndNotTheSameOneAgain) {
  Catalog catalog("pc1");
  Recorder recorder;
  catalog.host_up(host("pc2", 2), at("10.0.0.2"));
  catalog.add_observer(recorder);
  ASSERT_TRUE(catalog.stream_added(id_of(2), stream("lidar", "pc2", 1)));
  ASSERT_TRUE(catalog.stream_added(id_of(2), stream("lidar", "pc2", 1)));
  EXPECT_EQ(recorder.take(), Told{"+lidar:0@pc2"});
  ASSERT_TRUE(catalog.stream_added(id_of(2), stream("lidar", "pc2", 2)));
  EXPECT_EQ(recorder.take(), Told{"+lidar:0@pc2"});
  EXPECT_EQ(catalog.find(id_of(2))->streams.size(), 1u);
}

TEST(Catalog, ReportsAPropertyWithTheNewestSampleThatItDoesNotKeep) {
  Catalog catalog("pc1");
  Recorder recorder;
  catalog.host_up(host("pc2", 2), at("10.0.0.2"));
  catalog.add_observer(recorder);
  StreamInfo info = stream("lidar", "pc2");
  info.newest = 7;
  ASSERT_TRUE(catalog.stream_added(id_of(2), info));
  ASSERT_TRUE(catalog.stream_added(id_of(2), info, true));
  EXPECT_EQ(recorder.take(), (Told{"+lidar:0@pc2", "lidar:0@pc2 property after 7"}));
  EXPECT_EQ(catalog.find(id_of(2))->streams.begin()->second.newest, kNoTid);
}

TEST(Catalog, KeepsTheFirstAddressOfAHostThatAnswersAtTwo) {
  Catalog catalog("pc1");
  Recorder recorder;
  catalog.add_observer(recorder);
  catalog.host_up(host("pc2", 2), at("10.0.0.2"));
  catalog.host_up(host("pc2", 2), at("192.168.0.2"));
  EXPECT_EQ(recorder.take(), Told{"up pc2"});
  EXPECT_EQ(catalog.find(id_of(2))->address, at("10.0.0.2"));
}

TEST(Catalog, TakesAHostWithAnotherLifeForRestarted) {
  Catalog catalog("pc1");
  Recorder recorder;
  catalog.host_up(host("pc2", 2, 1), at("10.0.0.2"));
  ASSERT_TRUE(catalog.stream_added(id_of(2), stream("lidar", "pc2")));
  catalog.add_observer(recorder);
  catalog.host_up(host("pc2", 2, 2), at("192.168.0.2"));
  EXPECT_EQ(recorder.take(), (Told{"down pc2: its dssmd was restarted", "-lidar:0@pc2", "up pc2"}));
  EXPECT_EQ(catalog.find(id_of(2))->address, at("192.168.0.2"));
  EXPECT_FALSE(catalog.has({"lidar", 0, "pc2"}));
}

TEST(Catalog, FindsTheOnlyOwnerOfAStream) {
  Catalog catalog("pc1");
  catalog.host_up(host("pc2", 2), at("10.0.0.2"));
  catalog.host_up(host("pc3", 3), at("10.0.0.3"));
  ASSERT_TRUE(catalog.stream_added(id_of(3), stream("lidar", "pc3")));
  const auto owner = catalog.find_owner({"lidar", 0, ""});
  ASSERT_TRUE(owner) << owner.error().message;
  EXPECT_EQ((*owner)->greeting.host, "pc3");
  EXPECT_TRUE(catalog.has({"lidar", 0, "pc3"}));
  EXPECT_FALSE(catalog.has({"lidar", 0, "pc2"}));
  EXPECT_FALSE(catalog.has({"lidar", 1, "pc3"}));
}

TEST(Catalog, LetsTheNamedHostSayWhetherItHasAStream) {
  Catalog catalog("pc1");
  catalog.host_up(host("pc2", 2), at("10.0.0.2"));
  const auto owner = catalog.find_owner({"new", 0, "pc2"});
  ASSERT_TRUE(owner) << owner.error().message;
  EXPECT_EQ((*owner)->greeting.host, "pc2");
}

TEST(Catalog, NamesAllOwnersOfAStreamThatSeveralHave) {
  Catalog catalog("pc1");
  catalog.host_up(host("pc3", 2), at("10.0.0.3"));
  catalog.host_up(host("pc2", 3), at("10.0.0.2"));
  ASSERT_TRUE(catalog.stream_added(id_of(2), stream("lidar", "pc3")));
  ASSERT_TRUE(catalog.stream_added(id_of(3), stream("lidar", "pc2")));
  const auto owner = catalog.find_owner({"lidar", 0, ""});
  ASSERT_FALSE(owner);
  EXPECT_EQ(owner.error().code, Errc::conflict);
  EXPECT_EQ(owner.error().message,
            "several hosts have a stream 'lidar:0': host 'pc2' ('10.0.0.2:13776') and host 'pc3' "
            "('10.0.0.3:13776'); say which one: 'lidar:0@pc2'");
  EXPECT_EQ((*catalog.find_owner({"lidar", 0, "pc3"}))->greeting.host_id, id_of(2));
  catalog.host_down(id_of(2), {Errc::unavailable, "cut"});
  EXPECT_EQ((*catalog.find_owner({"lidar", 0, ""}))->greeting.host, "pc2");
}

TEST(Catalog, NamesBothAddressesOfAHostsNameThatTwoClaim) {
  Catalog catalog("pc1");
  catalog.host_up(host("pc2", 2), at("10.0.0.2"));
  catalog.host_up(host("pc2", 3), at("10.0.0.3"));
  EXPECT_EQ(catalog.hosts().size(), 2u) << "both are kept";
  ASSERT_TRUE(catalog.stream_added(id_of(3), stream("lidar", "pc2")));
  const auto found = catalog.find_owner({"lidar", 0, "pc2"});
  ASSERT_FALSE(found);
  EXPECT_EQ(found.error().code, Errc::conflict);
  EXPECT_NE(found.error().message.find("'10.0.0.2:13776' and '10.0.0.3:13776'"), std::string::npos)
      << found.error().message;
  EXPECT_EQ((*catalog.find_owner({"lidar", 0, ""}))->greeting.host_id, id_of(3))
      << "the stream itself is not in doubt";
}

TEST(Catalog, ReportsWhatItKnowsWhenItDoesNotFindAStream) {
  Catalog catalog("pc1");
  auto found = catalog.find_owner({"lidar", 0, ""});
  ASSERT_FALSE(found);
  EXPECT_EQ(found.error().code, Errc::not_found);
  EXPECT_NE(found.error().message.find("no other host answers"), std::string::npos);
  catalog.host_up(host("pc2", 2), at("10.0.0.2"));
  found = catalog.find_owner({"lidar", 0, ""});
  ASSERT_FALSE(found);
  EXPECT_EQ(found.error().code, Errc::not_found);
  EXPECT_NE(found.error().message.find("on this host 'pc1' or on 'pc2'"), std::string::npos)
      << found.error().message;
  found = catalog.find_host("pc9");
  ASSERT_FALSE(found);
  EXPECT_EQ(found.error().code, Errc::not_found);
  EXPECT_EQ(found.error().message.find("no host 'pc9' answers: those that answer are 'pc2';"), 0u)
      << found.error().message;
}

TEST(Catalog, BoundsTheStreamsOfOneHost) {
  Catalog catalog("pc1");
  catalog.host_up(host("pc2", 2), at("10.0.0.2"));
  catalog.host_up(host("pc3", 3), at("10.0.0.3"));
  StreamInfo info = stream("s", "pc2");
  for (std::size_t i = 0; i < kMaxStreamsPerHost; ++i) {
    info.id.id = static_cast<std::int32_t>(i);
    ASSERT_TRUE(catalog.stream_added(id_of(2), info));
  }
  info.id.id = static_cast<std::int32_t>(kMaxStreamsPerHost);
  const Result<void> refused = catalog.stream_added(id_of(2), info);
  ASSERT_FALSE(refused);
  EXPECT_EQ(refused.error().code, Errc::limit_exceeded);
  EXPECT_TRUE(catalog.stream_added(id_of(3), stream("s", "pc3"))) << "others do not pay for it";
  info.id.id = 0;
  info.incarnation = 2;
  EXPECT_TRUE(catalog.stream_added(id_of(2), info)) << "a change takes no place";
}

TEST(Catalog, LeavesOutFieldsWhenOneHostDescribesTooMuch) {
  Catalog catalog("pc1");
  catalog.host_up(host("pc2", 2), at("10.0.0.2"));
  StreamInfo info = stream("s", "pc2");
  info.type.fields.assign(1024, info.type.fields[0]);
  std::size_t described = 0;
  for (int i = 0; i < 1000; ++i) {
    info.id.id = i;
    ASSERT_TRUE(catalog.stream_added(id_of(2), info));
    const auto& known = catalog.find(id_of(2))->streams.at({"s", i});
    described += known.type.fields.empty() ? 0 : 1;
    EXPECT_EQ(known.type.name, "Odometry");
  }
  EXPECT_LT(described, 1000u);
  EXPECT_GT(described, 100u);
  EXPECT_LT(catalog.find(id_of(2))->stream_bytes, kMaxBytesPerHost + 1000 * 1000);
  for (int i = 0; i < 1000; ++i) catalog.stream_removed(id_of(2), {"s", i, "pc2"});
  EXPECT_EQ(catalog.find(id_of(2))->stream_bytes, 0u) << "all is given back";
}

TEST(Catalog, LetsAnObserverLeaveDuringItsNotification) {
  struct Leaving final : CatalogObserver {
    explicit Leaving(Catalog& of) : catalog(of) {}
    void on_host_up(const KnownHost&) override {
      catalog.remove_observer(*this);
      if (other) catalog.remove_observer(*other);
      ++events;
    }
    Catalog& catalog;
    CatalogObserver* other = nullptr;
    int events = 0;
  };
  Catalog catalog("pc1");
  Leaving first(catalog), second(catalog);
  first.other = &second;
  catalog.add_observer(first);
  catalog.add_observer(second);
  catalog.host_up(host("pc2", 2), at("10.0.0.2"));
  EXPECT_EQ(first.events, 1);
  EXPECT_EQ(second.events, 0) << "it is gone";
}

}  // namespace
}  // namespace dssm::daemon
