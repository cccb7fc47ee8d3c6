// SPDX-License-Identifier: Apache-2.0
//
// What programs ask about other hosts, with a fleet that answers when the test says: which requests
// go there, what comes back, who is told of changes, and what happens to those who do not wait.
#include <gtest/gtest.h>

#include <algorithm>
#include <optional>
#include <set>
#include <tuple>

#include "daemon/local/local_requests.hpp"
#include "tests/unit/daemon/local/fake_client.hpp"

namespace dssm::daemon {
namespace {

StreamInfo lidar_at(const std::string& host) {
  StreamInfo info;
  info.id = {"lidar", 0, host};
  info.type = odometry_type();
  info.incarnation = 5;
  return info;
}

// Keeps what it is asked. Its rings are made by a registry that calls itself by the owner's name.
class FakeFleet final : public Fleet {
 public:
  void observe(Observer* who) override { observer = who; }
  bool is_there(const StreamId& id) const override { return there.contains(id.str()); }
  void when_known(const StreamId&, std::size_t, std::function<void()> go_on) override {
    if (!knows_hosts) return waiting.push_back(std::move(go_on));
    go_on();
  }
  void open_reader(const StreamId& id, bool history, const std::string&,
                   Then<std::shared_ptr<Stream>> then) override {
    asked.push_back("open_reader " + id.str() + (history ? " with history" : ""));
    reader_then = std::move(then);
  }
  void want_history(const StreamId& id) override { asked.push_back("want_history " + id.str()); }
  void open_writer(const StreamId& id, const CreatePlan* plan, const std::string&,
                   Then<OpenedRing> then) override {
    asked.push_back("open_writer " + id.str() +
                    (plan ? " depth " + std::to_string(plan->history.depth) : ""));
    writer_plan = plan ? std::optional(*plan) : std::nullopt;
    writer_then = std::move(then);
  }
  Result<std::shared_ptr<Stream>> adopt_untrusted(const StreamId& id, Role role, OfferedFiles files,
                                                  bool history, const std::string&) override {
    asked.push_back(std::string("adopt ") + (role == Role::writer ? "writer " : "reader ") +
                    id.str() + (history ? " with history" : ""));
    offered_by_creator = files.may_create;
    return owner.adopt_untrusted(id, std::move(files));
  }
  void forward(const StreamId& id, const local::Request& request,
               Then<local::Response> then) override {
    local::Response response;
    if (request.has_info()) {
      asked.push_back("info " + id.str());
      proto::Stream& stream = *response.mutable_stream_list()->add_streams();
      wire::to_message(lidar_at("pc2"), stream);
      stream.mutable_mirror()->set_state(proto::Mirror::LIVE);
    } else if (request.has_get_property()) {
      asked.push_back("get_property " + id.str());
      response.mutable_property()->set_property("calibration");
    } else if (request.has_set_property()) {
      asked.push_back("set_property " + id.str() + " " + request.set_property().property());
      if (!answers_properties) return unanswered.push_back(std::move(then));
      response.mutable_done();
    } else {
      asked.push_back("remove " + id.str());
      return then(Error{Errc::not_found, "no such stream there"});
    }
    then(response);
  }
  void list(Then<std::vector<proto::Stream>> then) override {
    asked.push_back("list");
    list_then.push_back(std::move(then));
  }
  void list_clock_pairs(std::function<void(std::vector<ClockPair>)> then) override {
    asked.push_back("list_clock_pairs");
    then(pairs);
  }
  void follow_playback(const proto::FollowPlayback& request,
                       Then<proto::PlaybackFollowers> then) override {
    asked.push_back("follow_playback of " + request.driver_name());
    proto::PlaybackFollowers followers;
    followers.add_followers()->set_host("pc2");
    then(std::move(followers));
  }
  void list_nodes(NodeTable nodes, std::function<void(NodeTable)> then) override {
    asked.push_back("list_nodes");
    nodes.add({12, 1000, "mapper", Role::reader, StreamVia::local, "pc2"}, {"lidar", 0, "pc2"});
    then(std::move(nodes));
  }
  const StreamInfo* next_stream(const StreamId& id) const override {
    const auto place = [](const StreamId& of) { return std::tie(of.host, of.name, of.id); };
    const auto next = std::find_if(known.begin(), known.end(), [&](const StreamInfo& stream) {
      return place(id) < place(stream.id);
    });
    return next == known.end() ? nullptr : &*next;
  }
  std::vector<local::Host> hosts() const override {
    std::vector<local::Host> hosts(2);
    hosts[0].set_name("pc1");
    hosts[1].set_name("pc2");
    return hosts;
  }
  void describe(local::Daemon& daemon) const override {
    daemon.mutable_mdns()->set_phase(local::Mdns::RUNNING);
    daemon.mutable_mdns()->set_hosts_heard(7);
  }
  Result<UniqueFd> clock_page() const override { return Error{Errc::not_found, "no page here"}; }
  void ping(const std::string& host, Then<local::RoundTrip> then) override {
    asked.push_back("ping " + host);
    local::RoundTrip round_trip;
    round_trip.set_round_trip_ns(42);
    then(round_trip);
  }

  std::shared_ptr<Stream> ring(const std::string& name) {
    return owner.create({name, 0, ""}, odometry_type(), kHistory, 1).value().stream;
  }

  Registry owner{"pc2", kLimits};
  Observer* observer = nullptr;
  std::vector<std::string> asked;
  Then<std::shared_ptr<Stream>> reader_then;
  Then<OpenedRing> writer_then;
  std::optional<CreatePlan> writer_plan;
  bool offered_by_creator = false;
  std::vector<Then<std::vector<proto::Stream>>> list_then;
  bool knows_hosts = true;
  std::vector<std::function<void()>> waiting;  // until it does
  bool answers_properties = true;
  std::vector<Then<local::Response>> unanswered;
  std::vector<StreamInfo> known;  // in the order of hosts, names and ids
  std::vector<ClockPair> pairs;
  std::set<std::string> there;
};

using Asked = std::vector<std::string>;

struct WithFleet {
  FakeFleet fleet;  // used until the end of what is after it
};

class RemoteRequestsTest : public testing::Test, protected WithFleet, protected LocalDaemon {
 protected:
  std::unique_ptr<FakeClient> client = std::make_unique<FakeClient>(service, 5);

  RemoteRequestsTest()
      : LocalDaemon(false, {.max_opens = 2000, .max_opens_per_client = 2000}, &fleet) {
    client->greet();
  }

  // Puts a request that is answered later.
  void put(local::Request request, std::uint64_t serial = 77) {
    request.set_serial(serial);
    ASSERT_TRUE(client->put(request));
  }
};

local::Request open_at(const std::string& name, const std::string& host, bool for_writing = false) {
  local::Request request = open_request(name, for_writing);
  request.mutable_open()->mutable_id()->set_host(host);
  return request;
}

TEST_F(RemoteRequestsTest, OpensAMirrorWhenItIsThere) {
  put(open_at("lidar", "pc2"));
  EXPECT_EQ(fleet.asked, Asked{"open_reader lidar:0@pc2"});
  EXPECT_TRUE(client->received.empty());
  const auto ring = fleet.ring("lidar");
  fleet.reader_then(ring);
  const local::Response answer = client->next();
  EXPECT_EQ(answer.serial(), 77u);
  EXPECT_TRUE(answer.opened().mirror());
  EXPECT_EQ(answer.opened().stream().id().host(), "pc2");
  EXPECT_EQ(client->last_descriptors.size(), 3u);
  EXPECT_EQ(opens.counts(*ring).readers, 1u) << "so that its keeper knows of it";
  local::Request close;
  close.mutable_close()->set_handle(answer.opened().handle());
  EXPECT_TRUE(client->ask(close).has_done());
  EXPECT_EQ(opens.counts(*ring).readers, 0u);
}

TEST_F(RemoteRequestsTest, PassesOnThatHistoryIsWanted) {
  local::Request open = open_at("lidar", "pc2");
  open.mutable_open()->set_history(true);
  put(open);
  local::Request want;
  want.mutable_want_history()->mutable_id()->set_name("lidar");
  want.mutable_want_history()->mutable_id()->set_host("pc2");
  EXPECT_TRUE(client->ask(want).has_done());
  EXPECT_EQ(fleet.asked,
            (Asked{"open_reader lidar:0@pc2 with history", "want_history lidar:0@pc2"}));
}

TEST_F(RemoteRequestsTest, PrefersAnOwnStreamAndOpensOthersRemotely) {
  client->ask(create_request("lidar"));
  EXPECT_TRUE(client->ask(open_request("lidar")).has_opened());
  EXPECT_FALSE(client->ask(open_at("lidar", "pc1")).opened().mirror());
  EXPECT_TRUE(fleet.asked.empty());
  put(open_request("imu"));
  EXPECT_EQ(fleet.asked, Asked{"open_reader imu:0"});
  fleet.reader_then(Error{Errc::conflict, "pc2 and pc3 have it"});
  EXPECT_EQ(client->next().failure().code(), "conflict");
}

TEST_F(RemoteRequestsTest, NeverSearchesElsewhereForAStreamNamedAsItsOwn) {
  EXPECT_EQ(client->ask(open_at("imu", "pc1")).failure().code(), "not_found");
  EXPECT_TRUE(fleet.asked.empty());
}

TEST_F(RemoteRequestsTest, CreatesHereByDefault) {
  fleet.known = {lidar_at("pc2")};
  EXPECT_EQ(client->ask(create_request("lidar")).opened().stream().id().host(), "pc1");
  EXPECT_TRUE(fleet.asked.empty());
  local::Request create = create_request("lidar");
  create.mutable_create()->mutable_id()->set_host("pc2");
  put(create);
  EXPECT_EQ(fleet.asked, Asked{"open_writer lidar:0@pc2 depth 16"});
  fleet.writer_then(OpenedRing{fleet.ring("lidar"), true});
  const local::Response answer = client->next();
  EXPECT_TRUE(answer.opened().created());
  EXPECT_FALSE(answer.opened().mirror());
  EXPECT_EQ(answer.opened().stream().id().host(), "pc2");
  EXPECT_EQ(client->last_descriptors.size(), 4u);
}

TEST_F(RemoteRequestsTest, OpensForWritingWhatMustExist) {
  put(open_at("lidar", "pc2", true));
  EXPECT_EQ(fleet.asked, Asked{"open_writer lidar:0@pc2"});
  fleet.writer_then(OpenedRing{fleet.ring("lidar"), false});
  EXPECT_FALSE(client->next().opened().created());
  EXPECT_EQ(client->last_descriptors.size(), 4u);
}

TEST_F(RemoteRequestsTest, ForgetsWhatAClientOpenedThatLeft) {
  put(open_at("lidar", "pc2"));
  client.reset();
  const auto ring = fleet.ring("lidar");
  fleet.reader_then(ring);
  EXPECT_EQ(opens.counts(*ring).readers, 0u);
  EXPECT_TRUE(opens.entries().empty());
}

TEST_F(RemoteRequestsTest, PassesOnTheRest) {
  local::Request info, get, set, remove;
  info.mutable_info()->mutable_id()->set_name("lidar");
  const local::Response answer = client->ask(info);
  ASSERT_EQ(answer.stream_list().streams_size(), 1);
  EXPECT_EQ(answer.stream_list().streams(0).mirror().state(), proto::Mirror::LIVE);
  get.mutable_get_property()->mutable_id()->set_name("lidar");
  EXPECT_EQ(client->ask(get).property().property(), "calibration");
  set.mutable_set_property()->mutable_id()->set_name("lidar");
  set.mutable_set_property()->mutable_id()->set_host("pc2");
  set.mutable_set_property()->set_property("new");
  EXPECT_TRUE(client->ask(set).has_done());
  remove.mutable_remove()->mutable_id()->set_name("lidar");
  EXPECT_EQ(client->ask(remove).failure().message(), "no such stream there");
  EXPECT_EQ(fleet.asked, (Asked{"info lidar:0", "get_property lidar:0",
                                "set_property lidar:0@pc2 new", "remove lidar:0"}));
}

TEST_F(RemoteRequestsTest, ListsOwnStreamsFirst) {
  client->ask(create_request("odometry"));
  put(list_request());
  EXPECT_TRUE(client->received.empty());
  std::vector<proto::Stream> others(1);
  wire::to_message(lidar_at("pc2"), others[0]);
  fleet.list_then.at(0)(others);
  const local::Response list = client->next();
  ASSERT_EQ(list.stream_list().streams_size(), 2);
  EXPECT_EQ(list.stream_list().streams(0).id().host(), "pc1");
  EXPECT_EQ(list.stream_list().streams(1).id().host(), "pc2");
  local::Request own = list_request();
  own.mutable_list()->set_own_only(true);
  EXPECT_EQ(client->ask(own).stream_list().streams_size(), 1);
  EXPECT_EQ(fleet.asked, Asked{"list"});
}

TEST_F(RemoteRequestsTest, LeavesOutFieldsOrFailsWhenTheListGetsTooLong) {
  put(list_request(), 80);
  put(list_request(), 81);
  proto::Stream stream;
  wire::to_message(lidar_at("pc2"), stream);
  stream.mutable_type()->mutable_fields(0)->set_name(std::string(60'000, 'f'));
  fleet.list_then.at(0)(std::vector<proto::Stream>(300, stream));
  const local::Response list = client->next();
  ASSERT_EQ(list.stream_list().streams_size(), 300);
  EXPECT_EQ(list.stream_list().streams(0).type().fields_size(), 2);
  EXPECT_EQ(list.stream_list().streams(299).type().fields_size(), 0);
  stream.mutable_type()->clear_fields();
  stream.mutable_type()->set_name(std::string(127, 't'));
  fleet.list_then.at(1)(std::vector<proto::Stream>(150'000, stream));
  EXPECT_EQ(client->next().failure().code(), "limit_exceeded");
}

TEST_F(RemoteRequestsTest, ListsHosts) {
  local::Request hosts, ping;
  hosts.mutable_list_hosts();
  const local::Response list = client->ask(hosts);
  ASSERT_EQ(list.host_list().hosts_size(), 2);
  EXPECT_EQ(list.host_list().hosts(0).name(), "pc1");
  ping.mutable_ping_host()->set_host("pc2");
  EXPECT_EQ(client->ask(ping).round_trip().round_trip_ns(), 42);
  ping.mutable_ping_host()->set_host("pc1");
  fleet.knows_hosts = false;  // it needs none
  EXPECT_TRUE(client->ask(ping).has_round_trip());
  EXPECT_EQ(fleet.asked, Asked{"ping pc2"});
}

TEST_F(RemoteRequestsTest, ListsPairsOfClocks) {
  local::Request request;
  request.mutable_list_clock_pairs();
  fleet.pairs.resize(1);
  fleet.pairs[0].reader = "pc2";
  fleet.pairs[0].owner = "pc1";
  fleet.pairs[0].limit = Duration(7);
  const local::Response list = client->ask(request);
  ASSERT_EQ(list.clock_pair_list().pairs_size(), 1);
  EXPECT_EQ(wire::clock_pair_untrusted(list.clock_pair_list().pairs(0)), fleet.pairs[0]);
  fleet.pairs[0].reason = std::string(500, 'r');
  fleet.pairs.resize(40'000, fleet.pairs[0]);
  EXPECT_EQ(client->ask(request).failure().code(), "limit_exceeded");
  EXPECT_EQ(fleet.asked, (Asked{"list_clock_pairs", "list_clock_pairs"}));
}

TEST_F(RemoteRequestsTest, ListsTheProcessesOfAllHostsOwnOnesFirst) {
  local::Request request;
  request.mutable_list_nodes();
  EXPECT_TRUE(client->ask(create_request("odometry")).has_opened());
  const proto::NodeList list = client->ask(request).node_list();
  ASSERT_EQ(list.nodes_size(), 2);
  EXPECT_EQ(list.nodes(0).host(), "pc1");
  EXPECT_EQ(list.nodes(0).program(), "test");
  ASSERT_EQ(list.nodes(0).streams_size(), 1);
  EXPECT_EQ(list.nodes(0).streams(0).id().host(), "pc1");
  EXPECT_TRUE(list.nodes(0).streams(0).writer());
  EXPECT_EQ(list.nodes(1).host(), "pc2");
  EXPECT_EQ(list.nodes(1).program(), "mapper");
  EXPECT_EQ(fleet.asked, Asked{"list_nodes"});
}

TEST_F(RemoteRequestsTest, ReportsHowOtherHostsAreFound) {
  local::Request request;
  request.mutable_get_daemon();
  const local::Daemon daemon = client->ask(request).daemon();
  EXPECT_EQ(daemon.host(), "pc1");
  EXPECT_EQ(daemon.mdns().phase(), local::Mdns::RUNNING);
  EXPECT_EQ(daemon.mdns().hosts_heard(), 7u);
}

TEST_F(RemoteRequestsTest, BoundsWhatOneClientWaitsFor) {
  for (std::size_t i = 0; i < LocalService::kMaxAwaited; ++i) put(list_request(), 1000 + i);
  EXPECT_TRUE(client->received.empty());
  put(list_request(), 50);
  const local::Response refused = client->next();
  EXPECT_EQ(refused.serial(), 50u);
  EXPECT_EQ(refused.failure().code(), "limit_exceeded");
  fleet.list_then.at(0)(std::vector<proto::Stream>());
  EXPECT_EQ(client->next().serial(), 1000u);
  put(list_request(), 51);
  EXPECT_TRUE(client->received.empty()) << "there is room again";
}

// Of the programs of a user with limits.
class LimitedRequestsTest : public RemoteRequestsTest {
 protected:
  static constexpr std::uint32_t kUser = 4711;
  std::unique_ptr<FakeClient> connect(std::uint32_t uid) {
    auto program = std::make_unique<FakeClient>(service, 6, uid);
    program->greet();
    return program;
  }
  static void put(FakeClient& client, local::Request request, std::uint64_t serial = 77) {
    request.set_serial(serial);
    ASSERT_TRUE(client.put(request));
  }
};

TEST_F(LimitedRequestsTest, LeaveRoomForThoseOfOtherUsers) {
  std::size_t waiting = 0;
  for (bool is_full = false; !is_full;) {
    const auto program = connect(kUser);  // which does not wait for the answers
    for (std::size_t i = 0; i < LocalService::kMaxAwaited && !is_full; ++i) {
      put(*program, list_request());
      is_full = !program->received.empty();
      if (!is_full) ++waiting;
    }
    EXPECT_EQ(is_full ? program->next().failure().code() : "limit_exceeded", "limit_exceeded");
    ASSERT_LE(waiting, LocalService::kMaxAwaitedPerUser);
  }
  EXPECT_EQ(waiting, LocalService::kMaxAwaitedPerUser);
  const auto other = connect(kUser + 1), root = connect(0), same = connect(kUser);
  put(*other, list_request());
  put(*root, list_request());
  EXPECT_TRUE(other->received.empty()) << "it waits for an answer";
  EXPECT_TRUE(root->received.empty());
  fleet.list_then.at(0)(std::vector<proto::Stream>());
  put(*same, list_request());
  EXPECT_TRUE(same->received.empty()) << "there is room again";
}

TEST_F(LimitedRequestsTest, BoundTheirBytes) {
  const auto program = connect(kUser), other = connect(kUser + 1);
  local::Request property;
  property.mutable_set_property()->mutable_id()->set_host("pc2");
  property.mutable_set_property()->mutable_id()->set_name("lidar");
  property.mutable_set_property()->set_property(std::string(wire::kMaxPropertyBytes, 'x'));
  fleet.answers_properties = false;
  put(*program, property);
  EXPECT_TRUE(program->received.empty()) << "the largest property is possible";
  put(*program, property);
  EXPECT_EQ(program->next().failure().code(), "limit_exceeded");
  put(*other, property);
  EXPECT_TRUE(other->received.empty());
}

// There was no memory to send it.
TEST_F(RemoteRequestsTest, CountsARequestOnceWhoseAnswerIsFollowedByAFailure) {
  put(list_request(), 50);
  fleet.list_then.at(0)(std::vector<proto::Stream>());
  fleet.list_then.at(0)(Error{Errc::no_memory, "no memory left"});
  EXPECT_TRUE(client->next().has_stream_list());
  EXPECT_EQ(client->next().failure().code(), "no_memory");
  put(list_request(), 51);
  EXPECT_TRUE(client->received.empty()) << "it waits for an answer";
}

// --- rights

class RemoteRightsTest : public RemoteRequestsTest {
 protected:
  void allow(const std::string& line) { rights.set({parse_right(line).value()}); }
  static local::Request create_at(const std::string& host) {
    local::Request request = create_request("lidar");
    request.mutable_create()->mutable_id()->set_host(host);
    return request;
  }
};

TEST_F(RemoteRightsTest, CreateNothingHereBecauseAnotherHostHasAStreamOfThatName) {
  fleet.there = {"lidar:0", "lidar:0@pc1", "lidar:0@pc2"};
  allow("user:1000 write lidar");
  for (const char* host : {"", "pc1"}) {
    const proto::Failure refused = client->ask(create_at(host)).failure();
    EXPECT_EQ(refused.code(), "no_permission") << host;
    EXPECT_NE(refused.message().find("may not create"), std::string::npos) << refused.message();
  }
  EXPECT_TRUE(registry.streams().empty());
  EXPECT_TRUE(fleet.asked.empty());
}

TEST_F(RemoteRightsTest, ReachAsFarAtAnotherHostAsHere) {
  using Scope = CreatePlan::Scope;
  fleet.there = {"lidar:0@pc2"};
  const std::pair<const char*, Scope> expected[] = {{"write", Scope::join},
                                                    {"write,remove", Scope::join},
                                                    {"create", Scope::create},
                                                    {"create,remove", Scope::replace}};
  for (const auto& [verbs, scope] : expected) {
    allow(std::string("user:1000 ") + verbs + " lidar");
    put(create_at("pc2"));
    ASSERT_TRUE(fleet.writer_plan) << verbs;
    EXPECT_EQ(fleet.writer_plan->scope, scope) << verbs;
    EXPECT_FALSE(fleet.writer_plan->keep_existing) << verbs;
    fleet.writer_then(OpenedRing{fleet.ring("lidar"), false});
    EXPECT_TRUE(client->next().has_opened()) << verbs;
    EXPECT_EQ(opens.entries().rbegin()->second.creates, scope != Scope::join) << verbs;
  }
}

TEST_F(RemoteRightsTest, CountWhenTheHostIsKnown) {
  fleet.knows_hosts = false;
  fleet.there = {"lidar:0@pc2"};
  allow("user:1000 remove,create,property lidar");
  local::Request remove;
  remove.mutable_remove()->mutable_id()->set_name("lidar");
  remove.mutable_remove()->mutable_id()->set_host("pc2");
  put(remove, 50);
  put(create_at("pc2"), 51);
  allow("user:1000 write lidar");
  for (const auto& go_on : fleet.waiting) go_on();
  EXPECT_EQ(client->next().failure().code(), "no_permission");
  EXPECT_EQ(fleet.asked, Asked{"open_writer lidar:0@pc2 depth 16"});
  EXPECT_EQ(fleet.writer_plan->scope, CreatePlan::Scope::join);
}

TEST_F(RemoteRightsTest, OfAWriterWaitForTheHost) {
  fleet.knows_hosts = false;
  allow("user:1000 write lidar");
  put(create_at("pc2"));
  EXPECT_TRUE(client->received.empty()) << "nobody knows what pc2 has";
  ASSERT_EQ(fleet.waiting.size(), 1u);
  fleet.waiting[0]();
  ASSERT_TRUE(fleet.writer_plan);
  EXPECT_EQ(fleet.writer_plan->scope, CreatePlan::Scope::join);
}

// The catalog still had it.
TEST_F(RemoteRightsTest, SayWhyAStreamThatHasGoneIsNotCreated) {
  fleet.there = {"lidar:0@pc2"};
  allow("user:1000 write lidar");
  put(create_at("pc2"));
  fleet.writer_then(Error{Errc::not_found, "there is no stream 'lidar:0@pc2'"});
  const proto::Failure failure = client->next().failure();
  EXPECT_EQ(failure.code(), "not_found");
  EXPECT_NE(failure.message().find("may not create"), std::string::npos) << failure.message();
}

// --- changes

TEST_F(RemoteRequestsTest, NotifiesWatchersOfTheStreamsOfAllHosts) {
  client->ask(create_request("odometry"));
  fleet.known = {lidar_at("pc2")};
  local::Request watch;
  watch.mutable_watch();
  EXPECT_EQ(client->ask(watch).stream_event().stream().id().name(), "odometry");
  EXPECT_EQ(client->next().stream_event().stream().id().host(), "pc2");
  EXPECT_TRUE(client->next().has_done());
  fleet.observer->on_remote_stream_added(lidar_at("pc3"));
  const local::Response added = client->next();
  EXPECT_FALSE(added.stream_event().removed());
  EXPECT_EQ(added.stream_event().stream().id().host(), "pc3");
  EXPECT_EQ(added.stream_event().stream().incarnation(), 5u);
  fleet.observer->on_remote_stream_removed({"lidar", 0, "pc3"});
  const local::Response removed = client->next();
  EXPECT_TRUE(removed.stream_event().removed());
  EXPECT_EQ(removed.stream_event().stream().id().host(), "pc3");
}

TEST_F(RemoteRequestsTest, NotifiesReadersOfAReplacedMirror) {
  put(open_at("lidar", "pc2"));
  const auto ring = fleet.ring("lidar");
  fleet.reader_then(ring);
  const std::uint64_t handle = client->next().opened().handle();
  put(open_at("lidar", "pc2", true));
  fleet.writer_then(OpenedRing{ring, false});
  client->next();
  fleet.observer->on_ring_replaced(*ring);
  const local::Response event = client->next();
  EXPECT_EQ(event.serial(), 0u);
  EXPECT_EQ(event.replaced().handle(), handle);
  EXPECT_TRUE(client->received.empty()) << "writers are not concerned";
}

TEST_F(RemoteRequestsTest, NotifiesReadersWhenAnOwnStreamIsRecreated) {
  client->ask(create_request("odometry"));
  client->ask(create_request("other"));
  const std::uint64_t handle = client->ask(open_request("odometry")).opened().handle();
  client->ask(open_request("other"));
  local::Request remove;
  remove.mutable_remove()->mutable_id()->set_name("odometry");
  EXPECT_TRUE(client->ask(remove).has_done());
  EXPECT_TRUE(client->received.empty()) << "there is no successor yet";
  FakeClient writer(service, 6);
  writer.greet().ask(create_request("odometry"));
  EXPECT_EQ(client->next().replaced().handle(), handle);
  EXPECT_TRUE(client->received.empty());
  writer.ask(create_request("odometry"));
  EXPECT_TRUE(client->received.empty()) << "it joined, nothing is new";
  StreamInfo elsewhere = lidar_at("pc2");
  elsewhere.id.name = "other";
  fleet.observer->on_remote_stream_added(elsewhere);
  EXPECT_TRUE(client->received.empty()) << "what is read is still there";
}

TEST_F(RemoteRequestsTest, NotifiesReadersOfAStreamThatMovedToAnotherHost) {
  FakeClient particular(service, 6);
  particular.greet();
  const auto ring = fleet.ring("lidar");
  put(open_request("lidar"));
  fleet.reader_then(ring);
  const std::uint64_t handle = client->next().opened().handle();
  local::Request named = open_at("lidar", "pc2");
  named.set_serial(50);
  particular.put(named);
  fleet.reader_then(ring);
  EXPECT_TRUE(particular.next().has_opened());

  fleet.there = {"lidar:0@pc2", "lidar:0"};
  fleet.observer->on_remote_stream_added(lidar_at("pc2"));
  EXPECT_TRUE(client->received.empty()) << "it is the one that is read";
  fleet.there = {"lidar:0@pc2", "lidar:0@pc3"};
  fleet.observer->on_remote_stream_added(lidar_at("pc3"));
  EXPECT_TRUE(client->received.empty()) << "the one that is read is still there";
  fleet.there = {"lidar:0@pc3", "lidar:0"};
  fleet.observer->on_remote_stream_removed({"lidar", 0, "pc2"});
  EXPECT_EQ(client->next().replaced().handle(), handle) << "now the name means the other";
  fleet.there.clear();
  fleet.observer->on_remote_stream_removed({"lidar", 0, "pc3"});
  EXPECT_TRUE(client->received.empty()) << "there is none";
  fleet.there = {"lidar:0@pc4", "lidar:0"};
  fleet.observer->on_remote_stream_added(lidar_at("pc4"));
  EXPECT_EQ(client->next().replaced().handle(), handle);
  fleet.there.clear();
  EXPECT_EQ(client->ask(create_request("lidar")).replaced().handle(), handle) << "and home again";
  EXPECT_TRUE(particular.received.empty()) << "who names a host wants no other";
}

TEST_F(RemoteRequestsTest, NotifiesReadersOfAnOwnStreamThatMovedToAnotherHost) {
  client->ask(create_request("lidar"));
  const std::uint64_t any = client->ask(open_request("lidar")).opened().handle();
  const std::uint64_t own = client->ask(open_at("lidar", "pc1")).opened().handle();
  fleet.there = {"lidar:0@pc2", "lidar:0"};
  fleet.observer->on_remote_stream_added(lidar_at("pc2"));
  EXPECT_TRUE(client->received.empty());
  local::Request remove;
  remove.mutable_remove()->mutable_id()->set_name("lidar");
  EXPECT_EQ(client->ask(remove).replaced().handle(), any);
  EXPECT_TRUE(client->next().has_done());
  EXPECT_TRUE(client->received.empty());
  fleet.there.clear();
  EXPECT_EQ(client->ask(create_request("lidar")).replaced().handle(), any);
  EXPECT_EQ(client->next().replaced().handle(), own);
}

// --- after a restart of dssmd

class RecoveringRequestsTest : public RemoteRequestsTest {
 protected:
  RecoveringRequestsTest() { registry.begin_recovery(Registry::Recovery::streams); }
};

TEST_F(RecoveringRequestsTest, DoNotWaitWhenTheyNameAnotherHost) {
  put(open_at("lidar", "pc2"), 80);
  put(open_request("lidar"), 81);
  EXPECT_EQ(fleet.asked, Asked{"open_reader lidar:0@pc2"}) << "the other may be ours";
  registry.end_recovery();
  client->take_turn();
  EXPECT_EQ(fleet.asked, (Asked{"open_reader lidar:0@pc2", "open_reader lidar:0"}));
}

TEST_F(RecoveringRequestsTest, GiveBackWhatBelongsToAnotherHost) {
  std::vector<UniqueFd> kept;
  {
    Registry before("pc2", kLimits);
    kept = before.create({"lidar", 0, ""}, odometry_type(), kHistory, 1)
               .value()
               .stream->descriptors_for(Role::reader)
               .value();
  }
  local::Request offer;
  offer.mutable_offer()->mutable_id()->set_name("lidar");
  offer.mutable_offer()->mutable_id()->set_host("pc2");
  offer.mutable_offer()->set_any_host(true);
  offer.mutable_offer()->set_history(true);
  client->offered.push_back(std::move(kept));
  const local::Response answer = client->ask(offer);
  EXPECT_TRUE(answer.has_opened()) << answer.failure().message();
  EXPECT_TRUE(client->last_descriptors.empty());
  EXPECT_EQ(fleet.asked, Asked{"adopt reader lidar:0@pc2 with history"});
  ASSERT_EQ(opens.entries().size(), 1u);
  EXPECT_TRUE(opens.entries().begin()->second.any_host) << "as it was opened";
  EXPECT_TRUE(registry.streams().empty()) << "it is none of ours";
  EXPECT_EQ(client->ask(offer).failure().code(), "protocol") << "without its descriptors";
}

TEST_F(RecoveringRequestsTest, GiveBackWithTheRightsOfTheProgram) {
  local::Request offer;
  offer.mutable_offer()->mutable_id()->set_name("lidar");
  offer.mutable_offer()->mutable_id()->set_host("pc2");
  offer.mutable_offer()->set_for_writing(true);
  for (const char* verb : {"write", "create"}) {
    rights.set({parse_right(std::string("user:4711 ") + verb + " lidar").value()});
    Registry before("pc2", kLimits);
    const auto stream = before.create({"lidar", 0, ""}, odometry_type(), kHistory, 1)->stream;
    FakeClient program(service, 6, 4711);
    program.greet();
    program.offered.push_back(stream->descriptors_for(Role::writer).value());
    const local::Response answer = program.ask(offer);
    EXPECT_TRUE(answer.has_opened()) << answer.failure().message();
    EXPECT_EQ(fleet.offered_by_creator, std::string_view(verb) == "create");
    ASSERT_EQ(opens.entries().size(), 1u);
    EXPECT_EQ(opens.entries().begin()->second.creates, fleet.offered_by_creator);
    ASSERT_TRUE(fleet.owner.remove({"lidar", 0, ""}));
  }
}

}  // namespace
}  // namespace dssm::daemon
