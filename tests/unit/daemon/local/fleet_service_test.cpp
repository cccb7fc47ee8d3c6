// SPDX-License-Identifier: Apache-2.0
//
// What FleetService tells programs of this host and of mDNS. What it does with streams of other
// hosts is tested with real ones (tests/process/mirror, tests/process/fleet).
#include "daemon/local/fleet_service.hpp"

#include <gtest/gtest.h>

#include <filesystem>
#include <new>

#include "tests/support/log_recorder.hpp"
#include "tests/unit/daemon/clock/fake_chronyd.hpp"
#include "tests/unit/daemon/daemon_fixtures.hpp"
#include "tests/unit/daemon/scripted_host.hpp"

namespace dssm::daemon {
namespace {

class FleetServiceTest : public testing::Test {
 protected:
  FleetServiceTest() {
    char folder[] = "/tmp/dssm-fleet-service-XXXXXX";
    EXPECT_TRUE(::mkdtemp(folder));
    const FleetClock::Options options{{chronyd.address(), {}}, {}};
    clock.emplace(loop, options, *clock::ClockPageWriter::open(folder + std::string("/clock")),
                  std::make_shared<wire::ClockReport>(), self.host_id, catalog, log);
    std::filesystem::remove_all(folder);
    fleet.emplace(loop, FleetService::Self{self, {"10.0.0.1:13776"}, true, &*clock}, registry,
                  catalog, peers, mirrors, writers);
  }

  EventLoop loop = EventLoop::open(TimerQueue::Time::simulated).value();
  Resolver resolver{loop};
  Registry registry{"pc1", kLimits};
  LogRecorder log;
  const wire::Greeting self = greeting_of("pc1");
  const ChannelParts parts{loop, resolver, registry, log, self};
  Catalog catalog{"pc1"};
  FakeChronyd chronyd{loop, [](const FakeChronyd::Request&) {}};  // silent
  std::optional<FleetClock> clock;
  RemoteStreams<Mirror> mirrors{parts, catalog};
  RemoteStreams<RemoteWriter> writers{parts, catalog};
  ScriptedPeer peer{loop, "pc2"}, other{loop, "pc3"};
  Peers peers{loop, resolver, {peer.address(), other.address()}, self, catalog, log};
  std::optional<FleetService> fleet;
};

TEST_F(FleetServiceTest, ReportsThatMdnsIsOffUntilItsFirstState) {
  const local::Mdns shown = fleet->mdns();
  EXPECT_EQ(shown.phase(), local::Mdns::OFF);
  EXPECT_EQ(shown.error(), "");
  EXPECT_EQ(shown.announced(), 0u);
  EXPECT_FALSE(shown.own_host_seen());
}

TEST_F(FleetServiceTest, AnswersWhatWaitedForThePeersInTurns) {
  constexpr int kRequests = 3 * FleetService::kEarlyPerTurn;
  int answered = 0, before = 0, most = 0;
  for (int i = 0; i < kRequests; ++i) {
    fleet->when_known({"nothing", 0, ""}, 100, [&] { ++answered; });
  }
  EXPECT_EQ(answered, 0);
  run_until(loop, [&] {
    most = std::max(most, answered - std::exchange(before, answered));
    return answered == kRequests;
  });
  EXPECT_EQ(most, FleetService::kEarlyPerTurn);
}

TEST_F(FleetServiceTest, BoundsWhatWaitsForThePeers) {
  constexpr std::size_t kBytes = 1U << 20;
  std::size_t requests = 0;
  bool goes_on = false;
  for (; !goes_on && requests < 100; ++requests) {
    fleet->when_known({"nothing", 0, ""}, kBytes, [&] { goes_on = true; });
  }
  EXPECT_EQ(requests, FleetService::kMaxEarlyBytes / kBytes + 1);
}

TEST_F(FleetServiceTest, ReportsTheNewestStateOfMdns) {
  MdnsInfo state;
  state.phase = MdnsPhase::waiting;
  state.error = "no Avahi";
  peers.on_mdns_state(state);
  EXPECT_EQ(fleet->mdns().phase(), local::Mdns::WAITING);
  EXPECT_EQ(fleet->mdns().error(), "no Avahi");
  state.phase = MdnsPhase::running;
  state.error.clear();
  state.avahi_version = "avahi 0.8";
  state.announced = 3;
  state.withheld = 2;
  state.own_host_seen = true;
  state.hosts_heard = 5;
  peers.on_mdns_state(state);
  const local::Mdns shown = fleet->mdns();
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
  EXPECT_EQ(fleet->mdns().error().find('\x1b'), std::string::npos) << fleet->mdns().error();
  EXPECT_EQ(fleet->mdns().avahi_version().find('\n'), std::string::npos);
}

TEST_F(FleetServiceTest, ListsThisHostFirstAndWhatIsWrongWithIt) {
  wire::Greeting copy = self;
  ++copy.instance_id;
  peer.greet_as(copy);
  EXPECT_EQ(fleet->hosts().at(0).error(), "");
  run_until(loop, [&] { return fleet->hosts().at(1).state() == local::Host::REFUSED; });
  const local::Host shown = fleet->hosts().at(0);
  EXPECT_EQ(shown.name(), "pc1");
  EXPECT_EQ(shown.state(), local::Host::SELF);
  EXPECT_EQ(shown.addresses(0), "10.0.0.1:13776");
  EXPECT_TRUE(shown.insecure());
  EXPECT_NE(shown.error(), "");
  EXPECT_EQ(shown.error(), fleet->hosts().at(1).error());
}

TEST_F(FleetServiceTest, NamesTheStreamsOfOtherHostsByHostNameAndId) {
  EXPECT_EQ(fleet->next_stream({}), nullptr);
  run_until(loop, [this] { return catalog.hosts().size() == 2; });
  const auto add = [this](const StreamId& id) {
    StreamInfo stream;
    stream.id = id;
    ASSERT_TRUE(catalog.stream_added((*catalog.find_host(id.host))->greeting.host_id, stream));
  };
  add({"a", 0, "pc3"}), add({"b", 1, "pc2"}), add({"b", 0, "pc2"});
  add({"a", 2, "pc2"}), add({"c", 0, "pc3"});
  std::vector<std::string> names;
  for (const StreamInfo* stream = fleet->next_stream({}); stream;
       stream = fleet->next_stream(stream->id)) {
    names.push_back(stream->id.str());
  }
  EXPECT_EQ(names,
            (std::vector<std::string>{"a:2@pc2", "b:0@pc2", "b:1@pc2", "a:0@pc3", "c:0@pc3"}));
  // After streams that are not there any more.
  EXPECT_EQ(fleet->next_stream({"a", 9, "pc2"})->id.str(), "b:0@pc2");
  EXPECT_EQ(fleet->next_stream({"z", 0, "pc2"})->id.str(), "a:0@pc3");
}

TEST_F(FleetServiceTest, AnswersOneOfManyListsInATurnWhenAHostDoesNotAnswer) {
  run_until(loop, [this] { return catalog.hosts().size() == 2; });
  int answers = 0;
  for (int i = 0; i < 3; ++i) fleet->list([&](const auto& streams) { answers += bool(streams); });
  for (int expected = 1; expected <= 3; ++expected) {
    run_until(loop, [&] { return answers > 0; });
    EXPECT_EQ(std::exchange(answers, 0), 1);
  }
}

TEST_F(FleetServiceTest, FailsAListForWhichThereIsNoMemory) {
  run_until(loop, [this] { return catalog.hosts().size() == 2; });
  std::optional<Error> failed;
  fleet->list([&](const Result<std::vector<proto::Stream>>& streams) {
    if (streams) throw std::bad_alloc();
    failed = streams.error();
  });
  run_until(loop, [&] { return failed.has_value(); });
  EXPECT_EQ(failed->code, Errc::no_memory);
}

// --- nodes

class NodesTest : public FleetServiceTest {
 protected:
  // Asks for all nodes, until each peer has the request.
  void ask() {
    run_until(loop, [this] { return catalog.hosts().size() == 2; });
    NodeTable own("pc1");
    own.add({5, 1000, "viewer", Role::reader, StreamVia::mirror, "pc1"}, {"lidar", 0, "pc2"});
    fleet->list_nodes(std::move(own), [this](const NodeTable& all) {
      nodes.emplace();
      all.to_message(*nodes);
    });
    run_until(loop, [this] { return !peer.requests.empty() && !other.requests.empty(); });
  }
  static net::Frame answer(const ScriptedPeer& from) {
    EXPECT_TRUE(from.requests.at(0).has_list_nodes());
    net::Frame frame = answer_to(from.requests.at(0));
    frame.mutable_node_list();
    return frame;
  }
  // A node in the answer, with one stream.
  static proto::Node& add(net::Frame& answer, const std::string& host, std::int32_t pid,
                          const std::string& program, const StreamId& stream,
                          proto::Via via = proto::LOCAL) {
    proto::Node& node = *answer.mutable_node_list()->add_nodes();
    node.set_host(host);
    node.set_pid(pid);
    node.set_program(program);
    wire::to_message(stream, *node.add_streams()->mutable_id());
    node.mutable_streams(0)->set_via(via);
    return node;
  }
  // Each as "pc2 mapper 12: lidar:0@pc2", or "pc2: why it is not known".
  std::vector<std::string> wait() {
    run_until(loop, [this] { return nodes.has_value(); });
    std::vector<std::string> texts;
    for (const proto::Node& node : nodes->nodes()) {
      std::string text = node.host();
      if (!node.error().empty()) {
        texts.push_back(text + ": " + node.error());
        continue;
      }
      text += " " + node.program() + " " + std::to_string(node.pid()) + ":";
      for (const proto::NodeStream& use : node.streams()) {
        text += " " + StreamId{use.id().name(), use.id().id(), use.id().host()}.str();
      }
      texts.push_back(text);
    }
    return texts;
  }

  std::optional<proto::NodeList> nodes;
};

TEST_F(NodesTest, AreThoseOfAllHostsWithEachUseOnce) {
  ask();
  net::Frame from_peer = answer(peer), from_other = answer(other);
  add(from_peer, "pc2", 12, "driver", {"lidar", 0, "pc2"});
  add(from_peer, "pc1", 5, "viewer", {"lidar", 0, "pc2"}, proto::MIRROR);
  add(from_peer, "laptop", 0, "plot", {"lidar", 0, "pc2"}, proto::CONNECTION);
  add(from_other, "pc3", 12, "driver", {"radar", 0, "pc3"});
  peer.send(from_peer);
  other.send(from_other);
  EXPECT_EQ(wait(),
            (std::vector<std::string>{"pc1 viewer 5: lidar:0@pc2", "laptop plot 0: lidar:0@pc2",
                                      "pc2 driver 12: lidar:0@pc2", "pc3 driver 12: radar:0@pc3"}));
  EXPECT_EQ(nodes->nodes(0).uid(), 1000u);
  EXPECT_FALSE(nodes->nodes(1).has_uid());
}

TEST_F(NodesTest, ShowThatAHostDoesNotAnswerOrDoesNotKnowTheRequest) {
  ask();
  other.fail(other.requests.at(0), Errc::protocol, "dssmd of host 'pc3' does not \x1b know this");
  EXPECT_EQ(wait(), (std::vector<std::string>{"pc1 viewer 5: lidar:0@pc2",
                                              "pc2: host 'pc2' has not answered within 500 ms",
                                              "pc3: dssmd of host 'pc3' does not ? know this"}));
}

TEST_F(NodesTest, TakeNothingFromAPeerThatCannotBe) {
  ask();
  other.send(answer_to(other.requests.at(0)));
  net::Frame frame = answer(peer);
  add(frame, "", 1, "nowhere", {"a", 0, "pc2"});
  add(frame, "pc\n3", 1, "nowhere", {"a", 0, "pc2"});
  add(frame, "pc9", 1, "elsewhere", {"a", 0, "pc8"});  // neither its process nor its stream
  add(frame, "pc2", 1, "nameless", {"", 0, "pc2"});
  add(frame, "pc2", 1, "any", {"a", 0, ""});
  add(frame, "pc2", -1, "odd\n" + std::string(200, 'x'), {"a", 0, "pc8"}).set_error("a lie");
  peer.send(frame);
  EXPECT_EQ(wait(), (std::vector<std::string>{
                        "pc1 viewer 5: lidar:0@pc2",
                        "pc2 odd?" + std::string(wire::kMaxProgramBytes - 4, 'x') + " 0: a:0@pc8",
                        "pc3: host 'pc3' sent a response of another kind"}));
}

// --- pairs of clocks

class ClockPairsTest : public FleetServiceTest {
 protected:
  // Asks for all pairs, until each peer has the request.
  void ask() {
    run_until(loop, [this] { return catalog.hosts().size() == 2; });
    fleet->list_clock_pairs([this](std::vector<ClockPair> all) { pairs = std::move(all); });
    run_until(loop, [this] { return !peer.requests.empty() && !other.requests.empty(); });
  }
  // The answer of one of them, with a pair for each owner.
  static net::Frame answer(const ScriptedPeer& from, const std::vector<std::string>& owners) {
    EXPECT_TRUE(from.requests.at(0).has_list_clock_pairs());
    net::Frame frame = answer_to(from.requests.at(0));
    frame.mutable_clock_pair_list();
    for (const std::string& owner : owners) {
      ClockPair pair;
      pair.owner = owner;
      pair.limit = Duration(7);
      wire::to_message(pair, *frame.mutable_clock_pair_list()->add_pairs());
    }
    return frame;
  }
  void wait() {
    run_until(loop, [this] { return pairs.has_value(); });
  }
  // "pc1 of pc2", and the error.
  static std::string text(const ClockPair& pair) {
    return pair.reader + " of " + pair.owner + (pair.error.empty() ? "" : ": " + pair.error);
  }
  std::vector<std::string> texts() const {
    std::vector<std::string> texts;
    for (const ClockPair& pair : *pairs) texts.push_back(text(pair));
    return texts;
  }

  std::optional<std::vector<ClockPair>> pairs;
};

using Texts = std::vector<std::string>;

TEST_F(ClockPairsTest, AreThoseOfAllHostsByReaderThenOwner) {
  ask();
  other.send(answer(other, {}));
  peer.send(answer(peer, {"pc9", "pc3"}));
  wait();
  const char* const none = " has no connection to ";
  const char* const see = "; see `dssmctl hosts` and the key peers there";
  EXPECT_EQ(texts(), (Texts{"pc1 of pc2", "pc1 of pc3",
                            std::string("pc2 of pc1: 'pc2'") + none + "'pc1'" + see, "pc2 of pc3",
                            "pc2 of pc9", std::string("pc3 of pc1: 'pc3'") + none + "'pc1'" + see,
                            std::string("pc3 of pc2: 'pc3'") + none + "'pc2'" + see}));
  EXPECT_EQ(pairs->at(0).limit, ClockDemand().limit) << "this host's own";
  EXPECT_EQ(pairs->at(3).limit, Duration(7)) << "as stated there";
}

TEST_F(ClockPairsTest, ShowThatAHostDoesNotAnswerOrDoesNotKnowTheRequest) {
  ask();
  other.fail(other.requests.at(0), Errc::protocol, "dssmd of host 'pc3' does not \x1b know this");
  wait();
  EXPECT_EQ(texts(),
            (Texts{"pc1 of pc2", "pc1 of pc3", "pc2 of : host 'pc2' has not answered within 500 ms",
                   "pc3 of : dssmd of host 'pc3' does not ? know this"}));
  pairs.reset();
  peer.send(answer(peer, {"pc1"}));
  run_until(loop, [&, pings = peer.pings] { return peer.pings > pings + 1; });
  EXPECT_FALSE(pairs) << "a late answer is dropped";
}

TEST_F(ClockPairsTest, TakeNothingFromAPeerThatCannotBe) {
  ask();
  other.send(answer_to(other.requests.at(0)));
  Texts owners = {"pc1", "", "pc\n3"};
  for (std::size_t i = 0; i < wire::kMaxClockPairs + 5; ++i) {
    owners.push_back("n" + std::to_string(i));
  }
  net::Frame frame = answer(peer, owners);
  proto::ClockPair& first = *frame.mutable_clock_pair_list()->mutable_pairs(0);
  first.set_reader("pc7");
  first.set_error("a lie");
  first.set_reason("\a");
  peer.send(frame);
  wait();
  const auto from_peer = std::count_if(pairs->begin(), pairs->end(), [](const ClockPair& pair) {
    return pair.reader == "pc2" && pair.error.empty();
  });
  EXPECT_EQ(from_peer, wire::kMaxClockPairs);
  EXPECT_FALSE(std::any_of(pairs->begin(), pairs->end(), [](const ClockPair& pair) {
    return pair.reader == "pc2" && pair.owner.empty();
  })) << "what has no valid name of an owner is left out";
  const auto found = std::find_if(pairs->begin(), pairs->end(), [](const ClockPair& pair) {
    return pair.reader == "pc2" && pair.owner == "pc1";
  });
  ASSERT_NE(found, pairs->end());
  EXPECT_EQ(found->reason, "?");
  EXPECT_EQ(text(pairs->back()), "pc3 of : host 'pc3' sent a response of another kind");
}

}  // namespace
}  // namespace dssm::daemon
