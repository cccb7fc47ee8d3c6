// SPDX-License-Identifier: Apache-2.0
//
// One connection to dssmd: greeting, requests in turns, what is refused and how.
#include "daemon/serve/data_communicator.hpp"

#include "tests/unit/daemon/serve/server_rig.hpp"

namespace dssm::daemon {
namespace {

net::Frame list_request(std::uint64_t serial) {
  net::Frame frame;
  frame.set_serial(serial);
  frame.mutable_list();
  return frame;
}

net::Frame create_request(std::uint64_t serial, const std::string& name,
                          std::uint64_t payload_bytes, std::uint64_t depth) {
  net::Frame frame;
  frame.set_serial(serial);
  proto::Create& create = *frame.mutable_create();
  create.mutable_id()->set_name(name);
  create.mutable_type()->set_payload_bytes(payload_bytes);
  create.mutable_type()->set_alignment_bytes(1);
  create.set_depth(depth);
  create.set_cycle_ns(1000);
  return frame;
}

// The loop's timers count the ticks of the kernel's coarse clock.
constexpr Duration kTimersAreEarly = std::chrono::milliseconds(10);

std::string final_failure(ServerRig& rig, FakePeer& peer) {
  rig.turns();
  EXPECT_TRUE(peer.closed);
  const std::vector<SentItem> items = rig.take(peer);
  if (items.empty() || !items.back().frame.has_failure()) return "";
  EXPECT_EQ(items.back().frame.serial(), 0u);
  return items.back().frame.failure().message();
}

// --- greeting

TEST(DataCommunicator, SaysNothingBeforeThePeerSaidHello) {
  ServerRig rig;
  FakePeer peer;
  rig.connect(peer, false);
  rig.turns();
  EXPECT_TRUE(peer.sent.empty());
}

TEST(DataCommunicator, RefusesWhoDoesNotBeginWithHello) {
  ServerRig rig;
  FakePeer peer;
  rig.connect(peer, false);
  peer.put(list_request(1));
  EXPECT_NE(final_failure(rig, peer).find("Hello"), std::string::npos);
  EXPECT_EQ(rig.server.connections(), 0u);
}

TEST(DataCommunicator, RefusesAnotherVersionNamingBothAndBothHosts) {
  ServerRig rig;
  FakePeer peer;
  rig.connect(peer, false);
  net::Frame hello = hello_frame(greeting_of("future", "pc2"));
  hello.mutable_hello()->set_protocol_version(77);
  peer.put(hello);
  const std::string words = final_failure(rig, peer);
  EXPECT_NE(words.find("version 77"), std::string::npos) << words;
  EXPECT_NE(words.find("version 1"), std::string::npos) << words;
  EXPECT_NE(words.find("'pc1'"), std::string::npos) << words;
  EXPECT_NE(words.find("10.0.0.2"), std::string::npos) << words;
  ASSERT_EQ(rig.logger.warnings.size(), 1u);
  EXPECT_NE(rig.logger.warnings[0].find("version 77"), std::string::npos);
}

TEST(DataCommunicator, AnswersARequestWithoutSerialWithLastWords) {
  ServerRig rig;
  FakePeer peer;
  rig.connect(peer);
  peer.put(list_request(0));
  EXPECT_NE(final_failure(rig, peer).find("serial"), std::string::npos);
}

TEST(DataCommunicator, LogsTheLastWordsOfAPeer) {
  ServerRig rig;
  rig.create("a");
  FakePeer peer;
  rig.connect(peer);
  rig.open(peer, "a");
  net::Frame words;
  words.mutable_failure()->set_code("closed");
  words.mutable_failure()->set_message("had enough");
  peer.put(words);
  peer.vanish();
  rig.turns();
  EXPECT_TRUE(rig.logger.contains("had enough"));
  EXPECT_TRUE(rig.logger.warnings.empty());
}

// --- requests

TEST(DataCommunicator, AnswersWhatItDoesNotKnowAndGoesOn) {
  ServerRig rig;
  FakePeer peer;
  rig.connect(peer);
  net::Frame nothing;
  nothing.set_serial(5);
  EXPECT_EQ(rig.ask(peer, nothing).failure().code(), "protocol");
  net::Frame again = hello_frame(greeting_of("test", "pc2"));
  again.set_serial(6);
  EXPECT_EQ(rig.ask(peer, again).failure().code(), "protocol");
  EXPECT_TRUE(rig.ask(peer, list_request(7)).has_stream_list());
}

TEST(DataCommunicator, KeepsChannelsAndControlConnectionsApart) {
  ServerRig rig;
  rig.create("a");
  FakePeer channel, control;
  rig.connect(channel);
  EXPECT_EQ(rig.ask(channel, sample_read(1, 0)).failure().code(), "protocol") << "nothing is open";
  rig.open(channel, "a");
  EXPECT_EQ(rig.ask(channel, list_request(2)).failure().code(), "protocol");
  EXPECT_EQ(rig.ask(channel, create_request(3, "b", 8, 4)).failure().code(), "protocol");
  rig.connect(control);
  EXPECT_TRUE(rig.ask(control, list_request(4)).has_stream_list());
  EXPECT_EQ(rig.ask(control, create_request(5, "b", 8, 4)).failure().code(), "protocol");
}

TEST(DataCommunicator, CountsChannelsInTheStreamsDescription) {
  ServerRig rig;
  rig.create("a");
  FakePeer one, two, control;
  rig.connect(one);
  rig.open(one, "a");
  rig.connect(two);
  rig.open(two, "a");
  rig.connect(control);
  EXPECT_EQ(rig.ask(control, list_request(1)).stream_list().streams(0).channels(), 2u);
  one.vanish();
  rig.turns();
  EXPECT_EQ(rig.ask(control, list_request(2)).stream_list().streams(0).channels(), 1u);
}

TEST(DataCommunicator, ServesASlowAskerOneRequestAtATime) {
  ServerRig rig;
  const auto stream = rig.create("large", 1000, 64);
  rig.write(*stream, 20);
  FakePeer peer;
  rig.connect(peer);
  rig.open(peer, "large");
  peer.room = 0;
  std::vector<std::byte> requests;
  for (std::uint64_t serial = 1; serial <= 5000; ++serial) {
    const std::string text = wire::encode_frame(sample_read(serial, 15));
    const auto bytes = std::as_bytes(std::span(text));
    requests.insert(requests.end(), bytes.begin(), bytes.end());
  }
  peer.put(requests);
  rig.turns(200);
  EXPECT_TRUE(peer.sent.empty());
  EXPECT_FALSE(peer.closed) << "whoever does not read costs one answer, not its connection";
  peer.room = FakePeer::kAll;
  rig.turns(3000);
  const std::vector<SentItem> items = rig.take(peer, 1000);
  ASSERT_EQ(items.size(), 5000u);
  for (std::size_t i = 0; i < items.size(); ++i) {
    EXPECT_EQ(items[i].frame.serial(), i + 1);
    EXPECT_EQ(items[i].payload, ServerRig::payload_for(15, 1000));
  }
}

TEST(DataCommunicator, KeepsOneLongAnswerForASlowAskerNotAllOfThem) {
  ServerRig rig;
  rig.create("a");
  ASSERT_TRUE(rig.registry.set_property({"a", 0, ""}, std::string(1 << 20, 'p')));
  FakePeer peer;
  rig.connect(peer);
  rig.open(peer, "a");
  peer.room = 1000;
  for (std::uint64_t serial = 1; serial <= 25; ++serial) {
    net::Frame frame;
    frame.set_serial(serial);
    frame.mutable_get_property();
    peer.put(frame);
  }
  rig.turns(100);
  EXPECT_FALSE(peer.closed);
  peer.room = FakePeer::kAll;
  rig.turns(400);
  EXPECT_EQ(rig.take(peer).size(), 25u);
}

TEST(DataCommunicator, LetsOthersHaveTheirTurnBetweenManyRequests) {
  ServerRig rig;
  rig.create("a");
  FakePeer busy, other;
  rig.connect(busy);
  rig.connect(other);
  std::vector<std::byte> requests;
  for (std::uint64_t serial = 1; serial <= 1000; ++serial) {
    const std::string text = wire::encode_frame(list_request(serial));
    const auto bytes = std::as_bytes(std::span(text));
    requests.insert(requests.end(), bytes.begin(), bytes.end());
  }
  busy.put(requests);
  other.put(list_request(1));
  rig.turns(2);
  EXPECT_FALSE(other.sent.empty());
  EXPECT_LE(decode(busy.sent).size(), 3u * DataCommunicator::kRequestsPerTurn);
  rig.turns(300);
  EXPECT_EQ(rig.take(busy).size(), 1000u);
}

TEST(DataCommunicator, AnswersPingAndEndsWhenTheHeartStops) {
  ServerRig rig;
  FakePeer peer;
  rig.connect(peer);
  net::Frame ping;
  ping.set_serial(3);
  ping.mutable_ping();
  const MonoTime begin = MonoClock::now();
  EXPECT_TRUE(rig.ask(peer, ping).has_pong());
  ASSERT_TRUE(run_until(rig.loop, [&] { return peer.closed; }));
  EXPECT_GE(MonoClock::now() - begin, wire::kPeerTimeout);
  EXPECT_NE(final_failure(rig, peer).find("no bytes came"), std::string::npos);
  EXPECT_TRUE(rig.logger.warnings.empty()) << "a host that goes away is no fault of this one";
}

TEST(DataCommunicator, WaitsForHelloOnlySoLong) {
  ServerRig rig;
  FakePeer silent, slow;
  rig.connect(silent, false);
  rig.connect(slow, false);
  slow.put(std::vector<std::byte>{std::byte{5}});  // the length of a frame, and no more
  const MonoTime begin = MonoClock::now();
  ASSERT_TRUE(run_until(rig.loop, [&] { return silent.closed && slow.closed; }));
  EXPECT_GE(MonoClock::now() - begin, wire::kHelloTimeout - kTimersAreEarly);
  EXPECT_NE(final_failure(rig, silent).find("no Hello"), std::string::npos);
}

// --- creating

TEST(DataCommunicator, CreatesAStreamThatNoProgramHereCreated) {
  ServerRig rig;
  FakePeer peer, other;
  rig.connect(peer);
  const net::Frame made = rig.ask(peer, create_request(1, "new", 16, 8));
  ASSERT_TRUE(made.has_opened()) << made.failure().message();
  EXPECT_TRUE(made.opened().created());
  EXPECT_EQ(made.opened().stream().id().host(), "pc1");
  EXPECT_EQ(made.opened().stream().depth(), 8u);
  EXPECT_EQ(made.opened().stream().oldest(), -1);
  EXPECT_EQ(made.opened().stream().newest(), -1);
  EXPECT_NE(made.opened().stream().incarnation(), 0u);
  EXPECT_EQ((*rig.registry.find({"new", 0, ""}))->creator_pid(), 0);
  rig.connect(other);
  EXPECT_EQ(rig.ask(other, create_request(1, "new", 17, 8)).failure().code(), "type_mismatch");
  const net::Frame joined = rig.ask(other, create_request(2, "new", 16, 99));
  ASSERT_TRUE(joined.has_opened());
  EXPECT_FALSE(joined.opened().created());
}

TEST(DataCommunicator, TakesTheMemoryOfALongRingInTurns) {
  ServerRig rig;
  FakePeer peer, other;
  rig.connect(peer);
  rig.connect(other);
  // 40 MiB: several slices, and nobody else waits for them.
  peer.put(create_request(1, "long", 1 << 20, 40));
  other.put(list_request(1));
  rig.turns(3);
  EXPECT_TRUE(peer.sent.empty());
  EXPECT_EQ(rig.take(other).size(), 1u);
  ASSERT_TRUE(run_until(rig.loop, [&] { return !peer.sent.empty(); }));
  EXPECT_TRUE(rig.take(peer)[0].frame.has_opened());
  const auto stream = *rig.registry.find({"long", 0, ""});
  const OfferedFiles files = as_offer(stream->descriptors_for(Role::reader).value());
  struct stat file {};
  ASSERT_EQ(::fstat(files.ring.get(), &file), 0);
  EXPECT_GE(static_cast<std::uint64_t>(file.st_blocks) * 512, 40U << 20);
}

TEST(DataCommunicator, LeavesNoHalfMadeStreamBehind) {
  ServerRig rig;
  FakePeer peer;
  rig.connect(peer);
  peer.put(create_request(1, "long", 1 << 20, 40));
  rig.turns(3);
  EXPECT_TRUE(rig.registry.knows({"long", 0, ""}));
  peer.vanish();
  rig.turns();
  EXPECT_FALSE(rig.registry.knows({"long", 0, ""}));
}

TEST(DataCommunicator, SaysWhichLimitAStreamIsBeyond) {
  ServerRig rig;
  FakePeer peer;
  rig.connect(peer);
  const net::Frame refused = rig.ask(peer, create_request(1, "huge", 64 << 20, 1 << 20));
  EXPECT_EQ(refused.failure().code(), "limit_exceeded");
  EXPECT_EQ(rig.ask(peer, create_request(2, "bad@name", 8, 8)).failure().code(),
            "invalid_argument");
  EXPECT_TRUE(rig.ask(peer, create_request(3, "good", 8, 8)).has_opened()) << "it may try again";
}

// --- watching

net::Frame watch_request(std::uint64_t serial) {
  net::Frame frame;
  frame.set_serial(serial);
  frame.mutable_watch();
  return frame;
}

std::string events(const std::vector<SentItem>& items) {
  std::string text;
  for (const SentItem& item : items) {
    if (item.frame.has_done()) text += "done ";
    if (!item.frame.has_stream_event()) continue;
    const proto::StreamEvent& event = item.frame.stream_event();
    text += (event.removed() ? "-" : "+") + event.stream().id().name() + " ";
  }
  return text;
}

TEST(StreamWatch, TellsWhatIsThereThenAnswersThenTellsChanges) {
  ServerRig rig;
  rig.create("a");
  rig.create("b");
  FakePeer peer;
  rig.connect(peer);
  peer.put(watch_request(1));
  rig.turns();
  EXPECT_EQ(events(rig.take(peer)), "+a +b done ");
  rig.create("c");
  ASSERT_TRUE(rig.registry.remove({"a", 0, ""}));
  rig.create("a");
  rig.turns();
  EXPECT_EQ(events(rig.take(peer)), "+c -a +a ");
}

TEST(StreamWatch, NamesTheRingThatWasRemoved) {
  ServerRig rig;
  const std::uint64_t incarnation = rig.create("a")->incarnation();
  FakePeer peer;
  rig.connect(peer);
  peer.put(watch_request(1));
  rig.turns();
  rig.take(peer);
  ASSERT_TRUE(rig.registry.remove({"a", 0, ""}));
  rig.turns();
  const std::vector<SentItem> items = rig.take(peer);
  ASSERT_EQ(items.size(), 1u);
  EXPECT_EQ(items[0].frame.stream_event().stream().incarnation(), incarnation);
}

TEST(StreamWatch, WaitsForAPeerThatReadsSlowlyAndKeepsTheOrder) {
  ServerRig rig;
  for (int i = 0; i < 300; ++i) rig.create("s" + std::to_string(i));
  FakePeer peer;
  rig.connect(peer);
  peer.room = 500;
  peer.put(watch_request(1));
  rig.turns();
  const std::size_t told = peer.sent.size();
  EXPECT_LE(told, 500u);
  ASSERT_TRUE(rig.registry.remove({"s0", 0, ""}));    // told already
  ASSERT_TRUE(rig.registry.remove({"s299", 0, ""}));  // not told yet
  rig.create("s299");
  peer.room = FakePeer::kAll;
  rig.turns(50);
  const std::string text = events(rig.take(peer));
  EXPECT_EQ(text.find("+s0 "), 0u);
  EXPECT_GT(text.find("-s0 "), text.find("+s0 "));
  const std::size_t again = text.find("+s299 ");
  EXPECT_NE(again, text.npos);
  EXPECT_EQ(text.find("+s299 ", again + 1), text.npos) << "the removed one was not told of";
  EXPECT_GT(again, text.find("+s298 ")) << "in the order of creation";
  EXPECT_LT(again, text.find("done "));
  EXPECT_EQ(std::count(text.begin(), text.end(), '+'), 300);
}

// --- limits

TEST(ChannelServer, BoundsConnectionsInAllAndPerHost) {
  ServerRig rig({3, 2, 32U << 20});
  FakePeer peers[5];
  rig.connect(peers[0], true, true, 2);
  rig.connect(peers[1], true, true, 2);
  const auto refused = [&](FakePeer& peer, std::uint32_t host) {
    const Result<void> adopted =
        rig.server.adopt(std::make_unique<FakeTransport>(peer), address_of(host));
    return adopted ? std::string() : adopted.error().message;
  };
  EXPECT_NE(refused(peers[2], 2).find("max_connections_per_host = 2"), std::string::npos);
  EXPECT_NE(refused(peers[2], 2).find("'10.0.0.2'"), std::string::npos);
  rig.connect(peers[3], true, true, 3);
  EXPECT_NE(refused(peers[4], 4).find("max_connections = 3"), std::string::npos);
  peers[0].vanish();
  rig.turns();
  EXPECT_EQ(refused(peers[2], 2), "");
}

TEST(ChannelServer, BoundsTheMemoryOfAHost) {
  ServerRig rig({100, 100, 1U << 20});
  FakePeer peers[5];
  for (int i = 0; i < 3; ++i) rig.connect(peers[i], true, true, 2);
  const Result<void> refused =
      rig.server.adopt(std::make_unique<FakeTransport>(peers[3]), address_of(2));
  ASSERT_FALSE(refused);
  EXPECT_NE(refused.error().message.find("max_peer_memory = 1048576"), std::string::npos);
  rig.connect(peers[4], true, true, 3);  // others do not notice
}

TEST(ChannelServer, TellsWhoIsConnectedThatItStops) {
  FakePeer peer;
  {
    ServerRig rig;
    rig.connect(peer);
  }
  const std::vector<SentItem> items = decode(peer.sent);
  ASSERT_EQ(items.size(), 1u);
  EXPECT_EQ(items[0].frame.failure().code(), "unavailable");
  EXPECT_NE(items[0].frame.failure().message().find("'pc1'"), std::string::npos);
}

}  // namespace
}  // namespace dssm::daemon
