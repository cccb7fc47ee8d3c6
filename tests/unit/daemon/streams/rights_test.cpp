// SPDX-License-Identifier: Apache-2.0
//
// Rights: what lines allow whom, and what programs of this PC and other hosts get of it.
#include "daemon/streams/rights.hpp"

#include <gtest/gtest.h>
#include <unistd.h>

#include "tests/unit/daemon/local/fake_client.hpp"
#include "tests/unit/daemon/serve/server_rig.hpp"

namespace dssm::daemon {
namespace {

std::vector<Right> lines(const std::vector<std::string>& texts) {
  std::vector<Right> parsed;
  for (const std::string& text : texts) {
    Result<Right> right = parse_right(text);
    if (right) {
      parsed.push_back(*std::move(right));
    } else {
      ADD_FAILURE() << right.error().message;
    }
  }
  return parsed;
}

Identity user(std::uint32_t uid, std::uint32_t gid, std::vector<std::uint32_t> groups = {}) {
  Identity identity;
  identity.pid = 5;
  identity.uid = uid;
  identity.gid = gid;
  identity.groups = std::move(groups);
  identity.program = "test";
  return identity;
}

Identity remote(std::optional<wire::CertifiedPeer::Kind> kind, const std::string& name) {
  Identity identity;
  identity.address = "10.0.0.3:40000";
  identity.host = name;
  identity.program = "test";
  if (kind) identity.certified = wire::CertifiedPeer{*kind, name, {}, {}};
  return identity;
}
Identity host(const std::string& name) { return remote(wire::CertifiedPeer::Kind::host, name); }
Identity program(const std::string& name) {
  return remote(wire::CertifiedPeer::Kind::program, name);
}

// What `identity` may do with the stream `name`, by "WHO VERBS STREAMS" lines.
std::string verbs(const std::vector<std::string>& texts, const Identity& identity,
                  const std::string& name = "lidar") {
  return Rights(lines(texts)).verbs(identity, {name, 0, ""}).str();
}

TEST(Rights, AllowEverythingWithoutLines) {
  const Rights none;
  for (int action = 0; action <= static_cast<int>(Action::set_users); ++action) {
    EXPECT_TRUE(none.check(user(1000, 1000), static_cast<Action>(action), {"lidar", 0, ""}));
    EXPECT_TRUE(none.check(remote(std::nullopt, "pc2"), static_cast<Action>(action), {}));
  }
}

TEST(Rights, AreTheSumOfTheLinesForWhoAsks) {
  const std::vector<std::string> texts = {"everyone read l*", "user:1000 property lidar",
                                          "group:20 write lidar:0", "group:30 remove *",
                                          "local create camera"};
  EXPECT_EQ(verbs(texts, user(1000, 20, {30, 40})), "read,write,remove,property");
  EXPECT_EQ(verbs(texts, user(1001, 30, {20})), "read,write,remove");
  EXPECT_EQ(verbs(texts, user(1001, 40)), "read");
  EXPECT_EQ(verbs(texts, user(1001, 40), "camera"), "write,create");
  EXPECT_EQ(verbs(texts, user(1001, 40), "encoder"), "none");
  EXPECT_EQ(verbs(texts, host("pc2")), "read");
  EXPECT_EQ(verbs(texts, host("pc2"), "camera"), "none");
}

TEST(Rights, OfHostsAndProgramsCountByTheirCertificates) {
  const std::vector<std::string> texts = {"host:pc[23] read *", "program:view* write *"};
  EXPECT_EQ(verbs(texts, host("pc2")), "read");
  EXPECT_EQ(verbs(texts, host("pc4")), "none");
  EXPECT_EQ(verbs(texts, host("viewer")), "none") << "a host is no program";
  EXPECT_EQ(verbs(texts, program("viewer")), "write");
  EXPECT_EQ(verbs(texts, program("pc2")), "none");
  EXPECT_EQ(verbs(texts, remote(std::nullopt, "pc2")), "none") << "a name alone proves nothing";
  EXPECT_EQ(verbs(texts, user(1000, 1000)), "none");
}

TEST(Rights, RootAndTheOwnUserMayDoEverything) {
  EXPECT_EQ(verbs({"user:4242 read *"}, user(0, 0)), "all");
  EXPECT_EQ(verbs({"user:4242 read *"}, user(::geteuid(), 7)), "all");
  Identity root_elsewhere = remote(std::nullopt, "pc2");
  EXPECT_EQ(verbs({"user:4242 read *"}, root_elsewhere), "none");
}

TEST(Rights, EachActionNeedsItsVerb) {
  const auto allowed = [](Verb verb) {
    Right right;
    right.verbs = verb;
    right.streams = "lidar";
    const Rights rights({right});
    std::vector<Action> actions;
    for (int i = 0; i <= static_cast<int>(Action::set_users); ++i) {
      const auto action = static_cast<Action>(i);
      if (rights.check(user(1000, 1000), action, {"lidar", 0, ""})) actions.push_back(action);
    }
    return actions;
  };
  const auto with = [](std::vector<Action> some) {
    for (const Action always : {Action::greet, Action::close, Action::list, Action::open_clock_page,
                                Action::inspect, Action::ping, Action::set_users}) {
      some.push_back(always);
    }
    std::sort(some.begin(), some.end());
    return some;
  };
  EXPECT_EQ(allowed(Verb::read),
            with({Action::open_for_reading, Action::offer_for_reading, Action::open_channel,
                  Action::read, Action::get_property, Action::see}));
  EXPECT_EQ(allowed(Verb::write), with({Action::open_for_writing, Action::offer_for_writing,
                                        Action::open_channel, Action::publish, Action::see}));
  EXPECT_EQ(allowed(Verb::create), with({Action::create, Action::see}));
  EXPECT_EQ(allowed(Verb::remove), with({Action::remove, Action::see}));
  EXPECT_EQ(allowed(Verb::property),
            with({Action::open_channel, Action::set_property, Action::describe, Action::see}));
  EXPECT_EQ(allowed(Verb::clock), with({Action::open_clock}));
}

TEST(Rights, RefuseWithTheLineThatWouldAllowIt) {
  const Rights rights(lines({"user:4242 read *"}));
  const auto refusal = [&](const Identity& identity, Action action) {
    const Result<void> checked = rights.check(identity, action, {"lidar", 1, ""});
    EXPECT_EQ(checked.error().code, Errc::no_permission);
    return checked.error().message;
  };
  EXPECT_EQ(refusal(user(1000, 1000), Action::open_for_writing),
            "'test' (pid 5, uid 1000) may not write into stream 'lidar:1': dssmd's key 'rights' "
            "does not allow it; it takes a line such as \"user:1000 write lidar\" "
            "(docs/security.md)");
  EXPECT_EQ(refusal(host("pc3"), Action::read),
            "'test' on host 'pc3' at '10.0.0.3:40000' may not read stream 'lidar:1': dssmd's key "
            "'rights' does not allow it; it takes a line such as \"host:pc3 read lidar\" "
            "(docs/security.md)");
  EXPECT_EQ(rights.check(user(1000, 1000), Action::read, {"*", 0, ""}).error().message,
            "'test' (pid 5, uid 1000) may not read stream '*:0': dssmd's key 'rights' does not "
            "allow it; see docs/security.md \"Rights\"")
      << "a line for this name would be one for all";
  EXPECT_EQ(refusal(user(1000, 1000), Action::open_clock),
            "'test' (pid 5, uid 1000) may not use the playback clock: dssmd's key 'rights' does "
            "not allow it; it takes a line such as \"user:1000 clock *\" (docs/security.md)");
}

// --- programs of this PC

class LocalRightsTest : public testing::Test {
 protected:
  LogRecorder logger;
  Registry registry{"pc1", kLimits};
  OpenTable opens{{100, 100}};
  PlaybackClockOwner clock;
  Rights rights;
  LocalService service{registry, opens, clock, rights, logger};
  FakeClient client{service, 5};  // uid 1000

  void SetUp() override { client.greet(); }
  void set(const std::vector<std::string>& texts) {
    const Rights before(rights.lines());
    rights.set(lines(texts));
    service.on_new_rights(before);
  }
  // What `client` has received: "+lidar" added, "-lidar" removed, "replaced 1".
  std::string events() {
    std::string text;
    for (; !client.received.empty(); client.received.pop_front()) {
      const local::Response& response = client.received.front();
      if (response.has_replaced()) {
        text += " replaced " + std::to_string(response.replaced().handle());
      } else if (response.has_stream_event()) {
        const proto::StreamEvent& event = response.stream_event();
        text += (event.removed() ? " -" : " +") + event.stream().id().name();
      } else {
        text += " other";
      }
    }
    client.received_descriptors.clear();
    return text;
  }
};

TEST_F(LocalRightsTest, CountWhenARequestThatHasWaitedIsServed) {
  registry.begin_recovery(Registry::Recovery::streams);
  local::Request remove;
  remove.set_serial(50);
  remove.mutable_remove()->mutable_id()->set_name("lidar");
  ASSERT_TRUE(client.put(remove));
  set({"user:1000 read *"});
  EXPECT_TRUE(client.received.empty()) << "the stream may still be offered";
  registry.end_recovery();
  const local::Response refused = client.next();
  EXPECT_EQ(refused.serial(), 50U);
  EXPECT_EQ(refused.failure().code(), "no_permission") << refused.failure().message();
}

TEST_F(LocalRightsTest, OfAWriterWaitForAStreamThatMayComeBack) {
  registry.begin_recovery(Registry::Recovery::streams);
  set({"user:1000 write lidar"});
  local::Request create = daemon::create_request("lidar");
  create.set_serial(50);
  ASSERT_TRUE(client.put(create));
  EXPECT_TRUE(client.received.empty()) << "the stream may still be offered";
  registry.end_recovery();
  EXPECT_EQ(client.next().failure().code(), "no_permission") << "it was not";
}

TEST_F(LocalRightsTest, ListsAndEventsShowWhatTheAskerMaySee) {
  ASSERT_TRUE(client.ask(daemon::create_request("lidar")).has_opened());
  ASSERT_TRUE(client.ask(daemon::create_request("secret")).has_opened());
  set({"user:1000 read,create lidar*"});
  const local::Response list = client.ask(daemon::list_request());
  ASSERT_EQ(list.stream_list().streams_size(), 1);
  EXPECT_EQ(list.stream_list().streams(0).id().name(), "lidar");
  local::Request request;
  request.mutable_list_opens();
  EXPECT_EQ(client.ask(request).open_list().opens_size(), 1);
  request.mutable_info()->mutable_id()->set_name("secret");
  EXPECT_EQ(client.ask(request).failure().code(), "no_permission");
  request.mutable_info()->mutable_id()->set_name("lidar");
  EXPECT_EQ(client.ask(request).stream_list().streams_size(), 1);

  request.mutable_watch();
  request.set_serial(99);
  ASSERT_TRUE(client.put(request));
  EXPECT_EQ(events(), " +lidar other");
  ASSERT_TRUE(registry.create({"lidar2", 0, ""}, odometry_type(), {16, Duration(1)}, 1));
  ASSERT_TRUE(registry.create({"secret2", 0, ""}, odometry_type(), {16, Duration(1)}, 1));
  ASSERT_TRUE(registry.remove({"secret2", 0, ""}));
  client.take_turn();
  EXPECT_EQ(events(), " +lidar2");
  set({"user:1000 read,create *2"});
  EXPECT_EQ(events(), "") << "it is told all again, in parts";
  client.take_turn();
  EXPECT_EQ(events(), " -lidar +lidar2") << "and no word of what it may never see";
  set({"user:1000 read,create *"});
  client.take_turn();
  EXPECT_EQ(events(), " +lidar +secret +lidar2");
  // Two reloads, and a stream that is removed, before it is told.
  set({"user:1000 read,create secret"});
  set({"user:1000 read,create none"});
  ASSERT_TRUE(registry.remove({"lidar", 0, ""}));
  client.take_turn();
  EXPECT_EQ(events(), " -lidar -secret -lidar2");
}

TEST_F(LocalRightsTest, WhatIsNotAllowedIsRefusedAndLogged) {
  set({"user:1000 read lidar"});
  EXPECT_EQ(client.ask(daemon::create_request("lidar")).failure().code(), "no_permission");
  EXPECT_FALSE(registry.knows({"lidar", 0, ""}));
  EXPECT_TRUE(logger.contains("refuse a request: 'test' (pid 5, uid 1000) may not create"));
  ASSERT_TRUE(registry.create({"lidar", 0, ""}, odometry_type(), {16, Duration(1)}, 1));
  EXPECT_TRUE(client.ask(daemon::open_request("lidar")).has_opened());
  EXPECT_EQ(client.ask(daemon::open_request("lidar", true)).failure().code(), "no_permission");
}

TEST_F(LocalRightsTest, AnExistingStreamTakesOnlyTheRightToWrite) {
  ASSERT_TRUE(registry.create({"lidar", 0, ""}, odometry_type(), {16, Duration(1)}, 1));
  set({"user:1000 write *"});
  EXPECT_TRUE(client.ask(daemon::create_request("lidar")).has_opened());
  EXPECT_EQ(client.ask(daemon::create_request("camera")).failure().code(), "no_permission");
}

TEST_F(LocalRightsTest, WhoMayNotSeeAStreamDoesNotLearnWhetherItExists) {
  ASSERT_TRUE(registry.create({"secret", 0, ""}, odometry_type(), {16, Duration(1)}, 1));
  set({"user:1000 read,create public*"});
  const auto refusal = [&](const std::string& name) {
    const std::string text = client.ask(daemon::create_request(name)).failure().message();
    EXPECT_NE(text.find(name), std::string::npos) << text;
    return text.substr(0, text.find(name));
  };
  EXPECT_EQ(refusal("secret"), refusal("nothing"));
}

TEST_F(LocalRightsTest, AStreamIsReplacedByWhoMayCreateAndRemoveIt) {
  local::Request longer = daemon::create_request("lidar");
  longer.mutable_create()->set_depth(17);
  ASSERT_TRUE(registry.create({"lidar", 0, ""}, odometry_type(), {16, Duration(1)}, 1));
  for (const char* verbs : {"write", "write,create", "write,remove"}) {
    set({std::string("user:1000 ") + verbs + " *"});
    const proto::Failure refused = client.ask(longer).failure();
    EXPECT_EQ(refused.code(), "conflict") << verbs;
    EXPECT_NE(refused.message().find("uid 1000) may not"), std::string::npos) << refused.message();
  }
  set({"user:1000 write,create,remove *"});
  EXPECT_TRUE(client.ask(longer).opened().created());
}

// libdssm does so when there is no memory for the ring.
TEST_F(LocalRightsTest, WhoCreatedAStreamMayRemoveItWhileNobodyElseHasItOpen) {
  set({"user:1000 create *"});
  local::Request remove;
  remove.mutable_remove()->mutable_id()->set_name("lidar");
  ASSERT_TRUE(client.ask(daemon::create_request("lidar")).has_opened());
  {
    FakeClient other(service, 6);
    other.greet();
    ASSERT_TRUE(other.ask(daemon::create_request("lidar")).has_opened());
    EXPECT_EQ(client.ask(remove).failure().code(), "no_permission");
    EXPECT_EQ(other.ask(remove).failure().code(), "no_permission");
  }
  EXPECT_TRUE(client.ask(remove).has_done());
}

TEST_F(LocalRightsTest, RefusalsAreLoggedAtABoundedRate) {
  set({"user:4242 read *"});
  for (int i = 0; i < 1000; ++i) client.ask(daemon::open_request("lidar"));
  EXPECT_LT(logger.lines.size(), 100u);
}

TEST_F(LocalRightsTest, ReadersOfWhatIsNotAllowedAnyMoreReopenIt) {
  ASSERT_TRUE(client.ask(daemon::create_request("lidar")).has_opened());
  const local::Response reading = client.ask(daemon::open_request("lidar"));
  set({"user:1000 write lidar"});
  EXPECT_EQ(events(), " replaced " + std::to_string(reading.opened().handle()));
  EXPECT_EQ(client.ask(daemon::open_request("lidar")).failure().code(), "no_permission");
  EXPECT_TRUE(logger.contains("may not read stream 'lidar:0@pc1'"));
  EXPECT_EQ(opens.counts(*registry.find({"lidar", 0, ""}).value()).readers, 0u);
  EXPECT_EQ(opens.counts(*registry.find({"lidar", 0, ""}).value()).writers, 1u);
}

TEST_F(LocalRightsTest, WhoDrivesThePlaybackClockIsForThoseWhoMayUseIt) {
  proto::FollowPlayback follow;
  follow.set_driver(1);
  follow.set_driver_name("play@pc2");
  ASSERT_TRUE(clock.follow_untrusted(follow, MonoClock::now() + std::chrono::hours(1)));
  local::Request request;
  request.mutable_get_daemon();
  set({"user:1000 read *"});
  EXPECT_EQ(client.ask(request).daemon().playback_driver(), "");
  set({"user:1000 clock *"});
  EXPECT_EQ(client.ask(request).daemon().playback_driver(), "play@pc2");
}

TEST_F(LocalRightsTest, AStreamsRightsAreListed) {
  local::Request request;
  request.mutable_list_rights()->mutable_id()->set_name("lidar");
  local::Response response = client.ask(request);
  EXPECT_FALSE(response.right_list().restricted());
  EXPECT_EQ(response.right_list().own_verbs(), "all");
  set({"everyone read l*", "host:pc2 all camera", "user:1000 create,clock lidar:0"});
  response = client.ask(request);
  EXPECT_TRUE(response.right_list().restricted());
  EXPECT_EQ(response.right_list().own_verbs(), "read,write,create,clock");
  ASSERT_EQ(response.right_list().rights_size(), 2);
  EXPECT_EQ(response.right_list().rights(0).line(), "everyone read l*");
  EXPECT_EQ(response.right_list().rights(0).verbs(), "read");
  EXPECT_EQ(response.right_list().rights(1).verbs(), "write,create,clock");
  request.mutable_list_rights()->mutable_id()->set_name("camera");
  EXPECT_EQ(client.ask(request).failure().code(), "no_permission");
}

// --- other hosts

TEST(RemoteRights, ChannelsEndWhenTheyAreNotAllowedAnyMore) {
  Rights rights(lines({"everyone read,write *"}));
  ServerRig rig({16, 8, 32U << 20}, nullptr, &rights);
  rig.create("lidar");
  rig.create("camera");
  MemoryPeer reader, writer, control;
  rig.connect(reader);
  rig.open(reader, "lidar");
  net::Frame request;
  request.mutable_subscribe()->set_from_now(true);
  reader.put(with_serial(1, request));
  rig.turns();
  ASSERT_TRUE(reader.take().at(0).has_subscribed());
  rig.connect(writer);
  rig.open(writer, "lidar");
  request.mutable_start_publishing();
  ASSERT_TRUE(rig.ask(writer, with_serial(1, request)).has_publishing());
  rig.connect(control);
  request.mutable_watch();
  control.put(with_serial(1, request));
  rig.turns();
  ASSERT_EQ(control.take().size(), 3u);

  const Rights before(rights.lines());
  rights.set(lines({"everyone write lidar"}));
  rig.server.on_new_rights(before);
  rig.turns();
  EXPECT_TRUE(reader.closed);
  EXPECT_FALSE(writer.closed);
  const std::vector<net::Frame> events = control.take();
  ASSERT_EQ(events.size(), 1u);
  EXPECT_TRUE(events[0].stream_event().removed());
  EXPECT_EQ(events[0].stream_event().stream().id().name(), "camera");
  request.mutable_list();
  EXPECT_EQ(rig.ask(control, with_serial(2, request)).stream_list().streams_size(), 1);
  request.mutable_read()->set_newest(true);
  EXPECT_EQ(rig.ask(writer, with_serial(2, request)).failure().code(), "no_permission");
}

}  // namespace
}  // namespace dssm::daemon
