// SPDX-License-Identifier: Apache-2.0
//
// One connection to dssmd: greeting, requests in turns, what is refused and how.
#include "daemon/serve/data_communicator.hpp"

#include "tests/unit/daemon/remote/fake_clock_assessor.hpp"
#include "tests/unit/daemon/serve/server_rig.hpp"

namespace dssm::daemon {
namespace {

using namespace std::chrono_literals;

net::Frame list_request(std::uint64_t serial) { return with_serial(serial, list_frame()); }

net::Frame create_request(std::uint64_t serial, const std::string& name,
                          std::uint64_t payload_bytes, std::uint64_t depth) {
  return with_serial(serial, create_frame(name, payload_bytes, depth));
}

net::Frame read_request(std::uint64_t serial, Tid tid) {
  return with_serial(serial, read_frame(tid));
}

std::string final_failure(ServerRig& rig, MemoryPeer& peer) {
  rig.turns();
  EXPECT_TRUE(peer.closed);
  const std::vector<net::Frame> items = peer.take();
  if (items.empty() || !items.back().has_failure()) return "";
  EXPECT_EQ(items.back().serial(), 0u);
  return items.back().failure().message();
}

// --- greeting

TEST(DataCommunicator, SendsNothingBeforeThePeersHello) {
  ServerRig rig;
  MemoryPeer peer;
  rig.connect(peer, false);
  rig.turns();
  EXPECT_TRUE(peer.sent.empty());
}

TEST(DataCommunicator, RefusesAPeerThatDoesNotBeginWithHello) {
  ServerRig rig;
  MemoryPeer peer;
  rig.connect(peer, false);
  peer.put(list_request(1));
  EXPECT_NE(final_failure(rig, peer).find("Hello"), std::string::npos);
}

TEST(DataCommunicator, RefusesAnotherVersionNamingBothAndBothHosts) {
  ServerRig rig;
  MemoryPeer peer;
  rig.connect(peer, false);
  peer.put(hello_frame(greeting_of("pc2", "future"), 77));
  const std::string message = final_failure(rig, peer);
  EXPECT_NE(message.find("version 77"), std::string::npos) << message;
  EXPECT_NE(message.find("version 1"), std::string::npos) << message;
  EXPECT_NE(message.find("'pc1'"), std::string::npos) << message;
  EXPECT_NE(message.find("10.0.0.2"), std::string::npos) << message;
  ASSERT_EQ(rig.logger.warnings.size(), 1u);
  EXPECT_NE(rig.logger.warnings[0].find("version 77"), std::string::npos);
}

TEST(DataCommunicator, AnswersARequestWithoutSerialWithAFinalFailure) {
  ServerRig rig;
  MemoryPeer peer;
  rig.connect(peer);
  peer.put(list_request(0));
  EXPECT_NE(final_failure(rig, peer).find("serial"), std::string::npos);
}

TEST(DataCommunicator, LogsTheFinalFailureOfAPeer) {
  ServerRig rig;
  rig.create("a");
  MemoryPeer peer;
  rig.connect(peer);
  rig.open(peer, "a");
  peer.put(failure_frame(Errc::closed, "had enough"));
  peer.end();
  rig.turns();
  EXPECT_TRUE(rig.logger.contains("had enough"));
  EXPECT_TRUE(rig.logger.warnings.empty());
}

TEST(DataCommunicator, TakesOneFinalFailure) {
  ServerRig rig;
  MemoryPeer peer;
  rig.connect(peer);
  peer.put(failure_frame(Errc::closed, "had enough"));
  rig.turns();
  EXPECT_FALSE(peer.closed);
  peer.put(failure_frame(Errc::closed, "had more than enough"));
  rig.turns();
  EXPECT_TRUE(peer.closed);
}

// --- requests

TEST(DataCommunicator, AnswersUnknownRequestsAndContinues) {
  ServerRig rig;
  MemoryPeer peer;
  rig.connect(peer);
  EXPECT_EQ(rig.ask(peer, with_serial(5)).failure().code(), "protocol");
  const net::Frame again = hello_frame(greeting_of("pc2", "test"));
  EXPECT_EQ(rig.ask(peer, with_serial(6, again)).failure().code(), "protocol");
  EXPECT_TRUE(rig.ask(peer, list_request(7)).has_stream_list());
}

TEST(DataCommunicator, KeepsChannelsAndControlConnectionsApart) {
  ServerRig rig;
  rig.create("a");
  MemoryPeer channel, control;
  rig.connect(channel);
  EXPECT_EQ(rig.ask(channel, read_request(1, 0)).failure().code(), "protocol") << "nothing is open";
  rig.open(channel, "a");
  EXPECT_EQ(rig.ask(channel, list_request(2)).failure().code(), "protocol");
  EXPECT_EQ(rig.ask(channel, create_request(3, "b", 8, 4)).failure().code(), "protocol");
  rig.connect(control);
  EXPECT_TRUE(rig.ask(control, list_request(4)).has_stream_list());
  EXPECT_EQ(rig.ask(control, create_request(5, "b", 8, 4)).failure().code(), "protocol");
}

TEST(DataCommunicator, StatesItsPairsOfClocksOnControlConnections) {
  FakeClockAssessor assessor;
  ServerRig rig({16, 8, 32U << 20}, &assessor);
  assessor.pairs.resize(2);
  assessor.pairs[0].owner = "pc2";
  assessor.pairs[1].owner = "pc3";
  assessor.pairs[1].bound = std::chrono::milliseconds(2);
  rig.create("a");
  MemoryPeer control, channel;
  rig.connect(control);
  net::Frame request = with_serial(1);
  request.mutable_list_clock_pairs();
  const proto::ClockPairList list = rig.ask(control, request).clock_pair_list();
  ASSERT_EQ(list.pairs_size(), 2);
  EXPECT_EQ(wire::clock_pair_untrusted(list.pairs(0)), assessor.pairs[0]);
  EXPECT_EQ(wire::clock_pair_untrusted(list.pairs(1)), assessor.pairs[1]);
  EXPECT_EQ(rig.ask(control, create_request(2, "b", 8, 4)).failure().code(), "protocol")
      << "it is a control connection now";
  rig.connect(channel);
  rig.open(channel, "a");
  EXPECT_EQ(rig.ask(channel, request).failure().code(), "protocol");
}

// --- who uses a stream over a channel

// What Info says of the users of "a": "test on pc2 reads, connection".
std::vector<std::string> users_of_a(ServerRig& rig, MemoryPeer& control) {
  net::Frame info = with_serial(50);
  info.mutable_info()->mutable_id()->set_name("a");
  const proto::Stream stream = rig.ask(control, info).stream_list().streams(0);
  std::vector<std::string> users;
  std::uint32_t writers = 0;
  for (const proto::User& user : stream.users()) {
    writers += user.writer();
    users.push_back(user.program() + " (" + std::to_string(user.pid()) + ") on " + user.host() +
                    (user.writer() ? " writes, " : " reads, ") + proto::Via_Name(user.via()));
  }
  EXPECT_EQ(stream.remote_writers(), writers);
  EXPECT_EQ(stream.remote_readers(), users.size() - writers);
  EXPECT_EQ(stream.writers() + stream.readers(), 0u) << "those of its own host";
  return users;
}
using Users = std::vector<std::string>;

void greet(ServerRig& rig, MemoryPeer& peer, const wire::Greeting& greeting) {
  rig.connect(peer, false);
  peer.put(hello_frame(greeting));
  rig.turns();
  ASSERT_EQ(peer.take().size(), 1u);
}

TEST(DataCommunicator, NamesAProgramThatIsConnectedAndWhatItDoes) {
  ServerRig rig;
  rig.create("a");
  MemoryPeer program, control;
  rig.connect(control);
  EXPECT_EQ(users_of_a(rig, control), Users());
  wire::Greeting greeting = greeting_of("pc9", "viewer");
  greeting.pid = 4711;
  greet(rig, program, greeting);
  EXPECT_EQ(users_of_a(rig, control), Users()) << "it has not opened it";
  rig.open(program, "a");
  const std::string viewer = "viewer (4711) on pc9 ";
  EXPECT_EQ(users_of_a(rig, control), Users{viewer + "reads, CONNECTION"});
  rig.ask(program, with_serial(1, start_publishing_frame(5)));
  EXPECT_EQ(users_of_a(rig, control), Users{viewer + "writes, CONNECTION"})
      << "it has not read anything";
  rig.ask(program, with_serial(2, read_frame(0)));
  EXPECT_EQ(users_of_a(rig, control),
            (Users{viewer + "reads, CONNECTION", viewer + "writes, CONNECTION"}));
  program.end();
  rig.turns();
  EXPECT_EQ(users_of_a(rig, control), Users());
}

TEST(DataCommunicator, NamesTheProgramsOfAnotherHostAsItsDssmdStatesThem) {
  ServerRig rig;
  rig.create("a");
  MemoryPeer host, control, program;
  rig.connect(control);
  greet(rig, host, greeting_of("pc2"));
  rig.open(host, "a");
  EXPECT_EQ(users_of_a(rig, control), Users()) << "an older dssmd states none";
  net::Frame request = with_serial(1);
  proto::User& user = *request.mutable_set_users()->add_users();
  user.set_pid(12);
  user.set_program("map\nper");
  user.set_host("pc7");
  user.set_via(proto::CONNECTION);
  proto::User& writer = *request.mutable_set_users()->add_users();
  writer.set_pid(-3);
  writer.set_writer(true);
  EXPECT_TRUE(rig.ask(host, request).has_done());
  EXPECT_EQ(users_of_a(rig, control),
            (Users{"map?per (12) on pc2 reads, MIRROR", " (0) on pc2 writes, REMOTE_WRITER"}))
      << "it speaks for its own programs only";
  request.mutable_set_users()->clear_users();
  request.mutable_set_users()->set_readers(70);
  EXPECT_TRUE(rig.ask(host, request).has_done());
  const proto::Stream listed = rig.ask(control, list_request(3)).stream_list().streams(0);
  EXPECT_EQ(listed.remote_readers(), 70u) << "more than are named";
  EXPECT_EQ(listed.remote_writers(), 0u);

  for (std::size_t i = 0; i <= wire::kMaxChannelUsers; ++i)
    request.mutable_set_users()->add_users();
  EXPECT_EQ(rig.ask(host, request).failure().code(), "limit_exceeded");
  rig.connect(program);
  rig.open(program, "a");
  request.mutable_set_users()->clear_users();
  EXPECT_EQ(rig.ask(program, request).failure().code(), "protocol") << "it is not a dssmd";
}

TEST(DataCommunicator, SaysNoWriterOfAStreamThatAnotherHostOnlyReads) {
  ServerRig rig;
  const std::shared_ptr<Stream> stream = rig.create("a");
  rig.write(*stream, 5, WallClock::now() - std::chrono::seconds(60));
  MemoryPeer control, older, newer;
  rig.connect(control);
  const auto state = [&] {
    return rig.ask(control, list_request(1)).stream_list().streams(0).state();
  };
  const auto no_writer = static_cast<std::uint32_t>(StreamState::no_writer);
  const auto stalled = static_cast<std::uint32_t>(StreamState::stalled);
  EXPECT_EQ(state(), no_writer);

  wire::Greeting greeting = greeting_of("pc2");
  greeting.features.emplace_back(wire::kFeatureUsers);
  greet(rig, newer, greeting);
  rig.open(newer, "a");
  EXPECT_EQ(state(), no_writer) << "a mirror that no program uses now";
  net::Frame users = with_serial(1);
  users.mutable_set_users()->set_readers(1);
  EXPECT_TRUE(rig.ask(newer, users).has_done());
  EXPECT_EQ(state(), no_writer);
  users.mutable_set_users()->set_writers(1);
  EXPECT_TRUE(rig.ask(newer, users).has_done());
  EXPECT_EQ(state(), stalled);
  newer.end();
  rig.turns();
  EXPECT_EQ(state(), no_writer);

  greet(rig, older, greeting_of("pc3"));
  rig.open(older, "a");
  EXPECT_EQ(state(), stalled) << "an older dssmd does not state who writes";
}

TEST(DataCommunicator, ListsProcessesWithWhatThePeerMaySee) {
  Rights rights;
  ServerRig rig({16, 8, 32U << 20}, nullptr, &rights);
  const auto client = [](std::int32_t pid, const std::string& program) {
    ClientIdentity identity;
    identity.pid = pid;
    identity.uid = 1000;
    identity.program = program;
    identity.number = static_cast<ClientNumber>(pid);
    return std::make_shared<const ClientIdentity>(identity);
  };
  const auto a = rig.create("a"), secret = rig.create("secret");
  rig.opens.add({client(5, "mapper"), a, Role::reader});
  rig.opens.add({client(5, "mapper"), a, Role::reader});
  rig.opens.add({client(5, "mapper"), secret, Role::writer});
  rig.opens.add({client(6, "spy"), secret, Role::reader});
  MemoryPeer control, program;
  rig.connect(program, true, true, 3);
  rig.open(program, "a");
  rig.connect(control);
  net::Frame request = with_serial(1);
  request.mutable_list_nodes();
  const auto nodes = [&] {
    std::vector<std::string> texts;
    const net::Frame answer = rig.ask(control, request);
    for (const proto::Node& node : answer.node_list().nodes()) {
      std::string text = node.host() + " " + node.program() + (node.has_uid() ? " 1000:" : " -:");
      for (const proto::NodeStream& use : node.streams()) {
        text += " " + use.id().name() + "@" + use.id().host() + (use.writer() ? " w" : " r");
      }
      texts.push_back(text);
    }
    return texts;
  };
  EXPECT_EQ(nodes(), (Users{"pc1 mapper 1000: a@pc1 r secret@pc1 w", "pc1 spy 1000: secret@pc1 r",
                            "pc3 test -: a@pc1 r"}));
  rights.set({parse_right("everyone read a").value()});
  EXPECT_EQ(nodes(), (Users{"pc1 mapper 1000: a@pc1 r", "pc3 test -: a@pc1 r"}));
}

TEST(DataCommunicator, CountsChannelsInTheStreamsDescription) {
  ServerRig rig;
  rig.create("a");
  MemoryPeer one, two, control;
  rig.connect(one);
  rig.open(one, "a");
  rig.connect(two);
  rig.open(two, "a");
  rig.connect(control);
  EXPECT_EQ(rig.ask(control, list_request(1)).stream_list().streams(0).channels(), 2u);
  one.end();
  rig.turns();
  EXPECT_EQ(rig.ask(control, list_request(2)).stream_list().streams(0).channels(), 1u);
}

TEST(DataCommunicator, ChargesWhatAPeerHasItKeepToThePeer) {
  ServerRig rig;
  MemoryPeer peer, control;
  rig.connect(peer);
  ASSERT_TRUE(rig.ask(peer, create_request(1, "a", 8, 4)).opened().created());
  EXPECT_EQ(rig.registry.find({"a", 0, ""}).value()->account(), "'10.0.0.2'");
  rig.create("b");
  const std::uint64_t before = rig.registry.budgets().most_used();
  EXPECT_GE(before, rig.registry.find({"a", 0, ""}).value()->info().memory_bytes);
  rig.connect(control);
  net::Frame property = with_serial(2, {});
  property.mutable_set_property()->mutable_id()->set_name("b");
  property.mutable_set_property()->set_property("12345");
  ASSERT_TRUE(rig.ask(control, property).has_done());
  EXPECT_EQ(rig.registry.budgets().most_used(), before + 5);
  net::Frame on_channel = with_serial(3, {});
  on_channel.mutable_set_property()->set_property("123");
  ASSERT_TRUE(rig.ask(peer, on_channel).has_done());
  EXPECT_EQ(rig.registry.budgets().most_used(), before + 8);
}

TEST(DataCommunicator, ServesASlowPeerOneRequestAtATime) {
  ServerRig rig;
  const auto stream = rig.create("large", 1000, 64);
  rig.write(*stream, 20);
  MemoryPeer peer;
  rig.connect(peer);
  rig.open(peer, "large");
  peer.room = 0;
  Bytes requests;
  for (std::uint64_t serial = 1; serial <= 5000; ++serial) {
    const Bytes bytes = to_bytes(read_request(serial, 15));
    requests.insert(requests.end(), bytes.begin(), bytes.end());
  }
  peer.put(requests);
  rig.turns(200);
  EXPECT_TRUE(peer.sent.empty());
  EXPECT_FALSE(peer.closed) << "whoever does not read costs one answer, not its connection";
  peer.room = MemoryPeer::kAll;
  rig.turns(3000);
  const std::vector<net::Frame> items = peer.take();
  ASSERT_EQ(items.size(), 5000u);
  for (std::size_t i = 0; i < items.size(); ++i) {
    EXPECT_EQ(items[i].serial(), i + 1);
    EXPECT_EQ(payload_of(items[i]), ServerRig::payload_for(15, 1000));
  }
}

TEST(DataCommunicator, KeepsOneLongAnswerForASlowPeerNotAllOfThem) {
  ServerRig rig;
  rig.create("a");
  ASSERT_TRUE(rig.registry.set_property({"a", 0, ""}, std::string(1 << 20, 'p')));
  MemoryPeer peer;
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
  peer.room = MemoryPeer::kAll;
  rig.turns(400);
  EXPECT_EQ(peer.take().size(), 25u);
}

TEST(DataCommunicator, LetsOthersHaveTheirTurnBetweenManyRequests) {
  ServerRig rig;
  rig.create("a");
  MemoryPeer busy, other;
  rig.connect(busy);
  rig.connect(other);
  Bytes requests;
  for (std::uint64_t serial = 1; serial <= 1000; ++serial) {
    const Bytes bytes = to_bytes(list_request(serial));
    requests.insert(requests.end(), bytes.begin(), bytes.end());
  }
  busy.put(requests);
  other.put(list_request(1));
  run_until(rig.loop, [&] { return !other.sent.empty(); });
  EXPECT_LE(frames_of(busy.sent).size(), 3u * DataCommunicator::kRequestsPerTurn);
  rig.turns(300);
  EXPECT_EQ(busy.take().size(), 1000u);
}

TEST(DataCommunicator, AnswersPingAndEndsWithoutHeartbeats) {
  ServerRig rig;
  MemoryPeer peer;
  rig.connect(peer);
  const MonoTime begin = rig.loop.now();
  EXPECT_TRUE(rig.ask(peer, with_serial(3, ping_frame())).has_pong());
  run_until(rig.loop, [&] { return peer.closed; });
  EXPECT_GE(rig.loop.now() - begin, wire::kPeerTimeout);
  EXPECT_NE(final_failure(rig, peer).find("no bytes came"), std::string::npos);
  EXPECT_TRUE(rig.logger.warnings.empty()) << "a host that goes away is no fault of this one";
}

// The first Ping shows that it is a control connection.
TEST(DataCommunicator, SaysWhenAPingArrivedAndWhenItWasAnswered) {
  ServerRig rig;
  MemoryPeer peer;
  rig.connect(peer);
  rig.ask(peer, with_serial(3, ping_frame()));
  rig.own_clock->line = clock::ClockLine::through(clock::ClockReading::now(), 0);
  rig.own_clock->line.tolerance = 1ms;  // a slow machine, between two instructions
  const RawTime put = RawClock::now();
  peer.arrived = WallClock::now();
  while (RawClock::now() < put + 20ms) {
  }
  const net::Pong pong = rig.ask(peer, with_serial(4, ping_frame())).pong();
  EXPECT_GE(pong.received_ns(), to_ns(put));
  EXPECT_GE(pong.raw_ns(), to_ns(put + 20ms));
  EXPECT_LE(pong.raw_ns(), to_ns(RawClock::now()));
  EXPECT_LT(pong.received_ns(), to_ns(put + 10ms)) << "not when it was received from the kernel";
}

TEST(DataCommunicator, ReportsWhatTheHeartbeatsOfAPeerSayOfTheClocks) {
  std::vector<std::optional<clock::HeartbeatTimes>> reported;
  std::string host;
  RawTime reported_at;
  ServerRig rig;
  rig.on_heartbeat = [&](const wire::Greeting& them, const auto& returned) {
    host = them.host;
    reported_at = RawClock::now();
    reported.push_back(returned);
  };
  MemoryPeer peer;
  rig.connect(peer, true, true, 2, "dssmd");
  const auto ping = [&](std::uint64_t serial, std::int64_t raw_ns, std::int64_t answered_ns) {
    net::Frame frame = with_serial(serial, ping_frame());
    frame.mutable_ping()->set_raw_ns(raw_ns);
    frame.mutable_ping()->set_answered_ns(answered_ns);
    return rig.ask(peer, frame).pong();
  };
  const net::Pong first = ping(3, 1000, 900);  // there is no answer that could have come at 900
  ping(4, 0, 0);                               // not a heartbeat of a dssmd that measures
  const net::Pong last = ping(5, 3000, 2000);
  ping(6, 4000, 0);  // the last answer had not come there
  ASSERT_EQ(reported.size(), 4u);
  EXPECT_EQ(host, "pc2");
  EXPECT_FALSE(reported[0]);
  EXPECT_FALSE(reported[1]);
  ASSERT_TRUE(reported[2]);
  EXPECT_EQ(to_ns(reported[2]->asked), first.raw_ns());
  EXPECT_EQ(to_ns(reported[2]->received), 2000);
  EXPECT_EQ(to_ns(reported[2]->sent), 3000);
  EXPECT_EQ(to_ns(reported[2]->answered), last.received_ns());
  EXPECT_FALSE(reported[3]);
  const net::Pong answer = ping(7, 5000, 0);
  EXPECT_GE(answer.raw_ns(), to_ns(reported_at)) << "answering is the last thing to do";
}

// It may greet with the id of any host.
TEST(DataCommunicator, ReportsNoHeartbeatsOfPrograms) {
  int reported = 0;
  ServerRig rig;
  rig.on_heartbeat = [&](const auto&, const auto&) { ++reported; };
  MemoryPeer program;
  rig.connect(program);
  EXPECT_TRUE(rig.ask(program, with_serial(3, ping_frame())).has_pong());
  EXPECT_EQ(reported, 0);
}

// One with a channel, or with heartbeats, stays.
TEST(DataCommunicator, EndsConnectionsThatDoNothing) {
  ServerRig rig;
  rig.create("odometry");
  MemoryPeer idle, lister, channel;
  rig.connect(idle);
  rig.connect(channel);
  rig.open(channel, "odometry");
  rig.connect(lister);
  const MonoTime begin = rig.loop.now();
  bool is_half = false;
  EventSource half = EventSource::timer(rig.loop, [&] { is_half = true; });
  half.enable_in(DataCommunicator::kIdleTimeout / 2);
  run_until(rig.loop, [&] { return is_half; });
  EXPECT_TRUE(rig.ask(lister, with_serial(1, list_frame())).has_stream_list());
  run_until(rig.loop, [&] { return idle.closed; });
  EXPECT_GE(rig.loop.now() - begin, DataCommunicator::kIdleTimeout);
  EXPECT_FALSE(lister.closed) << "it asked for something meanwhile";
  run_until(rig.loop, [&] { return lister.closed; });
  EXPECT_GE(rig.loop.now() - begin, DataCommunicator::kIdleTimeout * 3 / 2);
  EXPECT_FALSE(channel.closed);
}

TEST(DataCommunicator, EndsConnectionsThatDoNotReadTheirAnswers) {
  ServerRig rig;
  const auto stream = rig.create("large", 1000, 64);
  rig.write(*stream, 20);
  MemoryPeer silent, slow, slow_network, subscriber;
  for (MemoryPeer* peer : {&silent, &slow, &slow_network, &subscriber}) {
    rig.connect(*peer);
    rig.open(*peer, "large");
  }
  subscriber.put(with_serial(1, subscribe_from_oldest_frame()));
  rig.turns();
  slow_network.progress.emplace().waiting_bytes = 1'000'000;
  for (MemoryPeer* peer : {&silent, &slow, &slow_network, &subscriber}) {
    peer->room = 0;
    if (peer != &subscriber) peer->put(read_request(2, 15));
  }
  rig.write(*stream, 5);
  rig.turns();
  const MonoTime begin = rig.loop.now();
  // As the test's peers are always writable, the loop is never idle: time goes on by hand.
  const auto pass = [&](Duration time) {
    bool is_over = false;
    EventSource end = EventSource::timer(rig.loop, [&] { is_over = true; });
    end.enable_in(time);
    while (!is_over) {
      rig.loop.timers().run_next();
      rig.turns(2);
    }
  };
  pass(DataCommunicator::kOutputTimeout / 2);
  EXPECT_FALSE(silent.closed);
  while (rig.loop.now() - begin < 3 * DataCommunicator::kOutputTimeout) {
    slow.room = 10;
    slow_network.progress->waiting_bytes -= 10;
    pass(DataCommunicator::kOutputTimeout / 4);
    if (rig.loop.now() - begin >= 2 * DataCommunicator::kOutputTimeout) {
      EXPECT_TRUE(silent.closed);
    }
  }
  EXPECT_FALSE(slow.closed);
  EXPECT_FALSE(slow_network.closed) << "the kernel has less of it";
  EXPECT_FALSE(subscriber.closed) << "perhaps it is stopped by a debugger";
  EXPECT_TRUE(rig.logger.contains("the other side has read nothing for 10 s of what waits for it"));
}

TEST(DataCommunicator, WaitsForHelloUntilItsTimeout) {
  ServerRig rig;
  MemoryPeer silent, slow;
  rig.connect(silent, false);
  rig.connect(slow, false);
  slow.put(Bytes{std::byte{5}});  // the length of a frame, and no more
  const MonoTime begin = rig.loop.now();
  run_until(rig.loop, [&] { return silent.closed && slow.closed; });
  EXPECT_GE(rig.loop.now() - begin, wire::kHelloTimeout);
  EXPECT_NE(final_failure(rig, silent).find("no Hello"), std::string::npos);
}

// --- creating

TEST(DataCommunicator, CreatesAStreamThatNoProgramHereCreated) {
  ServerRig rig;
  MemoryPeer peer, other;
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
  const net::Frame joined = rig.ask(other, create_request(2, "new", 16, 8));
  ASSERT_TRUE(joined.has_opened());
  EXPECT_FALSE(joined.opened().created());
}

TEST(DataCommunicator, ReplacesAStreamThatNoPeerHasOpen) {
  ServerRig rig;
  rig.create("s", 16, 8);
  MemoryPeer peer, other;
  rig.connect(peer);
  rig.connect(other);
  rig.open(peer, "s");
  const net::Frame refused = rig.ask(other, create_request(1, "s", 16, 99));
  EXPECT_EQ(refused.failure().code(), "conflict");
  EXPECT_NE(refused.failure().message().find("open in 'test' (pid 0) on host 'pc2'"),
            std::string::npos)
      << refused.failure().message();
  peer.end();
  rig.turns();
  const net::Frame replaced = rig.ask(other, create_request(2, "s", 16, 99));
  EXPECT_TRUE(replaced.opened().created());
  EXPECT_EQ(replaced.opened().stream().depth(), 99u);
}

TEST(DataCommunicator, TakesTheMemoryOfALongRingInTurns) {
  ServerRig rig;
  MemoryPeer peer, other;
  rig.connect(peer);
  rig.connect(other);
  // 40 MiB: several slices, and nobody else waits for them.
  peer.put(create_request(1, "long", 1 << 20, 40));
  other.put(list_request(1));
  rig.turns(3);
  EXPECT_TRUE(peer.sent.empty());
  EXPECT_EQ(other.take().size(), 1u);
  run_until(rig.loop, [&] { return !peer.sent.empty(); });
  EXPECT_TRUE(peer.take()[0].has_opened());
  const auto stream = *rig.registry.find({"long", 0, ""});
  const OfferedFiles files = as_offer(stream->descriptors_for(Role::reader).value());
  struct stat file {};
  ASSERT_EQ(::fstat(files.ring.get(), &file), 0);
  EXPECT_GE(static_cast<std::uint64_t>(file.st_blocks) * 512, 40U << 20);
}

TEST(DataCommunicator, LeavesNoHalfMadeStream) {
  ServerRig rig;
  MemoryPeer peer;
  rig.connect(peer);
  peer.put(create_request(1, "long", 1 << 20, 40));
  rig.turns(3);
  EXPECT_TRUE(rig.registry.knows({"long", 0, ""}));
  peer.end();
  rig.turns();
  EXPECT_FALSE(rig.registry.knows({"long", 0, ""}));
}

TEST(DataCommunicator, ReportsWhichLimitAStreamExceeds) {
  ServerRig rig;
  MemoryPeer peer;
  rig.connect(peer);
  const net::Frame refused = rig.ask(peer, create_request(1, "huge", 64 << 20, 1 << 20));
  EXPECT_EQ(refused.failure().code(), "limit_exceeded");
  EXPECT_EQ(rig.ask(peer, create_request(2, "bad@name", 8, 8)).failure().code(),
            "invalid_argument");
  EXPECT_TRUE(rig.ask(peer, create_request(3, "good", 8, 8)).has_opened()) << "it may try again";
}

// --- while programs give streams back after a restart of dssmd

TEST(Recovering, AStreamThatIsMissingIsWaitedFor) {
  ServerRig rig;
  rig.create("here");
  rig.registry.begin_recovery(Registry::Recovery::streams);
  MemoryPeer peer, other;
  rig.connect(peer);
  rig.connect(other);
  peer.put(with_serial(1, open_frame("missing")));
  rig.turns();
  EXPECT_TRUE(peer.take().empty()) << "neither opened nor refused";
  rig.open(other, "here");
  rig.create("missing");  // as if a program gave it back
  rig.turns();
  const std::vector<net::Frame> answers = peer.take();
  ASSERT_EQ(answers.size(), 1u);
  EXPECT_TRUE(answers[0].has_opened()) << answers[0].failure().message();
}

TEST(Recovering, NoPeerTakesANameBeforeTheEnd) {
  ServerRig rig;
  rig.registry.begin_recovery(Registry::Recovery::streams);
  MemoryPeer creating, opening;
  rig.connect(creating);
  rig.connect(opening);
  creating.put(create_request(1, "new", 8, 4));
  opening.put(with_serial(1, open_frame("other")));
  rig.turns();
  EXPECT_TRUE(creating.take().empty() && opening.take().empty());
  rig.registry.end_recovery();
  rig.turns();
  EXPECT_TRUE(creating.take().at(0).opened().created());
  EXPECT_EQ(opening.take().at(0).failure().code(), "not_found");
}

TEST(Recovering, ListsWaitAndWatchesDoNotEndTheirFirstEvents) {
  ServerRig rig;
  rig.create("a");
  rig.registry.begin_recovery(Registry::Recovery::streams);
  MemoryPeer listing, watching;
  rig.connect(listing);
  rig.connect(watching);
  listing.put(list_request(1));
  watching.put(with_serial(1, watch_frame()));
  rig.turns();
  EXPECT_TRUE(listing.take().empty());
  EXPECT_EQ(watching.take().size(), 1u) << "the event of what is there";
  EXPECT_TRUE(rig.ask(watching, with_serial(2, ping_frame())).has_pong());
  rig.create("b");
  rig.turns();
  EXPECT_TRUE(watching.take().at(0).has_stream_event());
  rig.registry.end_recovery();
  rig.turns();
  EXPECT_EQ(listing.take().at(0).stream_list().streams_size(), 2);
  EXPECT_TRUE(watching.take().at(0).has_done());
}

// --- watching

net::Frame watch_request(std::uint64_t serial) { return with_serial(serial, watch_frame()); }

std::string events(const std::vector<net::Frame>& items) {
  std::string text;
  for (const net::Frame& item : items) {
    if (item.has_done()) text += "done ";
    if (!item.has_stream_event()) continue;
    const proto::StreamEvent& event = item.stream_event();
    text += (event.removed()        ? "-"
             : event.property_set() ? "p"
                                    : "+") +
            event.stream().id().name() + " ";
  }
  return text;
}

TEST(StreamWatch, SendsWhatIsThereThenAnswersThenSendsChanges) {
  ServerRig rig;
  rig.create("a");
  rig.create("b");
  MemoryPeer peer;
  rig.connect(peer);
  peer.put(watch_request(1));
  rig.turns();
  EXPECT_EQ(events(peer.take()), "+a +b done ");
  rig.create("c");
  ASSERT_TRUE(rig.registry.remove({"a", 0, ""}));
  rig.create("a");
  rig.turns();
  EXPECT_EQ(events(peer.take()), "+c -a +a ");
}

TEST(StreamWatch, SendsAStreamAgainThatIsDescribedNow) {
  ServerRig rig;
  const auto stream = rig.create("a");
  TypeInfo type = stream->type();
  type.name = "Odometry";
  MemoryPeer peer;
  rig.connect(peer);
  peer.put(watch_request(1));
  rig.turns();
  peer.take();
  ASSERT_TRUE(rig.registry.create({"a", 0, ""}, type, kHistory, 43));
  rig.turns();
  const std::vector<net::Frame> items = peer.take();
  ASSERT_EQ(items.size(), 1u);
  EXPECT_EQ(items[0].stream_event().stream().type().name(), "Odometry");
}

TEST(StreamWatch, NamesTheRingThatWasRemoved) {
  ServerRig rig;
  const std::uint64_t incarnation = rig.create("a")->incarnation();
  MemoryPeer peer;
  rig.connect(peer);
  peer.put(watch_request(1));
  rig.turns();
  peer.take();
  ASSERT_TRUE(rig.registry.remove({"a", 0, ""}));
  rig.turns();
  const std::vector<net::Frame> items = peer.take();
  ASSERT_EQ(items.size(), 1u);
  EXPECT_EQ(items[0].stream_event().stream().incarnation(), incarnation);
}

TEST(StreamWatch, WaitsForAPeerThatReadsSlowlyAndKeepsTheOrder) {
  ServerRig rig;
  for (int i = 0; i < 300; ++i) rig.create("s" + std::to_string(i));
  MemoryPeer peer;
  rig.connect(peer);
  peer.room = 500;
  peer.put(watch_request(1));
  rig.turns();
  const std::size_t sent_bytes = peer.sent.size();
  EXPECT_LE(sent_bytes, 500u);
  ASSERT_TRUE(rig.registry.remove({"s0", 0, ""}));    // told already
  ASSERT_TRUE(rig.registry.remove({"s299", 0, ""}));  // not told yet
  rig.create("s299");
  peer.room = MemoryPeer::kAll;
  rig.turns(50);
  const std::string text = events(peer.take());
  EXPECT_EQ(text.find("+s0 "), 0u);
  EXPECT_GT(text.find("-s0 "), text.find("+s0 "));
  const std::size_t again = text.find("+s299 ");
  EXPECT_NE(again, text.npos);
  EXPECT_EQ(text.find("+s299 ", again + 1), text.npos) << "the removed one was not told of";
  EXPECT_GT(again, text.find("+s298 ")) << "in the order of creation";
  EXPECT_LT(again, text.find("done "));
  EXPECT_EQ(std::count(text.begin(), text.end(), '+'), 300);
}

TEST(StreamWatch, SendsOneEventForPropertiesThatAPeerReadsTooSlowlyFor) {
  ServerRig rig;
  const auto a = rig.create("a");
  rig.create("b");
  MemoryPeer peer;
  rig.connect(peer);
  peer.put(watch_request(1));
  rig.turns();
  EXPECT_EQ(events(peer.take()), "+a +b done ");
  const auto set = [&](const char* name, const std::string& property) {
    ASSERT_TRUE(rig.registry.set_property({name, 0, ""}, property));
  };
  set("a", "1");
  rig.turns();
  EXPECT_EQ(events(peer.take()), "pa ");
  peer.room = 0;
  for (int i = 0; i < 1000; ++i) {
    set("a", std::to_string(i));
    set("b", std::to_string(i));
    if (i % 100 == 0) rig.turns();
    if (i == 500) rig.write(*a);
  }
  rig.write(*a);  // is written with the property already
  peer.room = MemoryPeer::kAll;
  rig.turns(50);
  const std::vector<net::Frame> items = peer.take();
  EXPECT_EQ(events(items), "pa pb pa ") << "the first one was on its way";
  EXPECT_EQ(items.back().stream_event().stream().newest(), 0);
}

// --- limits

TEST(ChannelServer, BoundsConnectionsInAllAndPerHost) {
  ServerRig rig({3, 2, 32U << 20});
  MemoryPeer peers[5];
  rig.connect(peers[0], true, true, 2);
  rig.connect(peers[1], true, true, 2);
  const auto refused = [&](MemoryPeer& peer, std::uint32_t host) {
    const Result<void> adopted =
        rig.server.adopt(std::make_unique<MemoryTransport>(peer), address_of(host));
    return adopted ? std::string() : adopted.error().message;
  };
  EXPECT_NE(refused(peers[2], 2).find("max_connections_per_host = 2"), std::string::npos);
  EXPECT_NE(refused(peers[2], 2).find("'10.0.0.2'"), std::string::npos);
  rig.connect(peers[3], true, true, 3);
  EXPECT_NE(refused(peers[4], 4).find("max_connections = 3"), std::string::npos);
  peers[0].end();
  rig.turns();
  EXPECT_EQ(refused(peers[2], 2), "");
}

// Those who connect and say nothing keep nobody out.
TEST(ChannelServer, GivesUpTheOldestSilentConnectionOfTheMostCrowdedNetwork) {
  ServerRig rig({4, 3, 32U << 20});
  MemoryPeer greeted, few, crowd[2], next[2];
  rig.connect(greeted, true, true, 2);
  rig.connect(few, false, true, 3);
  rig.connect(crowd[0], false, true, 4);
  rig.connect(crowd[1], false, true, 4);
  rig.connect(next[0], true, true, 5);
  EXPECT_TRUE(crowd[0].closed) << "the oldest of two";
  EXPECT_NE(final_failure(rig, crowd[0]).find("it has sent no Hello"), std::string::npos);
  EXPECT_TRUE(rig.logger.contains("give up a connection from '10.0.0.4'"));
  EXPECT_FALSE(crowd[1].closed);
  EXPECT_FALSE(few.closed);
  rig.connect(next[1], true, true, 6);
  EXPECT_TRUE(few.closed) << "the oldest of one each";
  EXPECT_FALSE(greeted.closed);
  EXPECT_FALSE(next[0].closed);
  crowd[1].put(hello_frame(greeting_of("pc4", "test")));
  rig.turns();
  MemoryPeer late;
  EXPECT_FALSE(rig.server.adopt(std::make_unique<MemoryTransport>(late), address_of(7)))
      << "all have greeted";
}

TEST(ChannelServer, KeepsPlacesForConfiguredPeers) {
  ServerRig rig({2, 2, 32U << 20});
  rig.configured = address_of(3).str();
  MemoryPeer silent, others[3], configured[3];
  rig.connect(silent, false, true, 2);
  rig.connect(others[0], true, true, 2);
  rig.connect(configured[0], true, true, 3);
  EXPECT_FALSE(silent.closed) << "its place is not needed";
  rig.connect(configured[1], false, true, 3);
  rig.connect(others[1], true, true, 4);
  EXPECT_TRUE(silent.closed);
  EXPECT_FALSE(configured[1].closed) << "has a place of its own";
  EXPECT_FALSE(rig.server.adopt(std::make_unique<MemoryTransport>(others[2]), address_of(5)));
  rig.connect(configured[2], true, true, 3);
  EXPECT_TRUE(configured[1].closed) << "of the same host, which may have two";
  EXPECT_FALSE(others[0].closed);
  EXPECT_FALSE(others[1].closed);
}

TEST(ChannelServer, GivesUpASilentConnectionOfAHostWithTooMany) {
  ServerRig rig({100, 2, 32U << 20});
  MemoryPeer other, silent[2], next;
  rig.connect(other, false, true, 3);
  rig.connect(silent[0], false, true, 2);
  rig.connect(silent[1], false, true, 2);
  rig.connect(next, true, true, 2);
  EXPECT_TRUE(silent[0].closed);
  EXPECT_FALSE(silent[1].closed);
  EXPECT_FALSE(other.closed) << "of another host";
}

TEST(ChannelServer, BoundsTheMemoryOfAHost) {
  ServerRig rig({100, 100, 1U << 20});
  MemoryPeer peers[5];
  for (int i = 0; i < 3; ++i) rig.connect(peers[i], true, true, 2);
  const Result<void> refused =
      rig.server.adopt(std::make_unique<MemoryTransport>(peers[3]), address_of(2));
  ASSERT_FALSE(refused);
  EXPECT_NE(refused.error().message.find("max_peer_memory = 1048576"), std::string::npos);
  rig.connect(peers[4], true, true, 3);  // others do not notice
}

TEST(DataCommunicator, ChargesARequestThatWaits) {
  // A connection takes 320 KiB, the request as much as is left while it is parsed.
  ServerRig rig({100, 100, 900U << 10});
  MemoryPeer peer, other;
  rig.connect(peer);
  const auto adopt_other = [&] {
    return rig.server.adopt(std::make_unique<MemoryTransport>(other), address_of(2));
  };
  peer.room = 0;
  peer.put(list_request(1));
  net::Frame request;
  request.set_serial(2);
  request.mutable_set_property()->mutable_id()->set_name("odometry");
  request.mutable_set_property()->set_property(std::string(280'000, 'x'));
  peer.put(request);
  rig.turns(20);
  const Result<void> refused = adopt_other();  // of the same host
  ASSERT_FALSE(refused);
  EXPECT_NE(refused.error().message.find("max_peer_memory"), std::string::npos);
  peer.room = MemoryPeer::kAll;
  rig.turns(20);
  EXPECT_TRUE(adopt_other()) << "it is served";
}

TEST(DataCommunicator, ParsesNoRequestThatIsTooLong) {
  ServerRig rig;
  MemoryPeer peer;
  rig.connect(peer);
  net::Frame request;
  request.set_serial(2);
  for (int i = 0; i < 5000; ++i) request.mutable_create()->mutable_type()->add_fields();
  *request.mutable_create()->mutable_type()->mutable_name() = std::string(10'000, 'x');
  peer.put(request);
  EXPECT_NE(final_failure(rig, peer).find("a type of 5000 fields"), std::string::npos);
}

TEST(ChannelServer, NotifiesConnectedPeersThatItStops) {
  MemoryPeer peer;
  {
    ServerRig rig;
    rig.connect(peer);
  }
  const std::vector<net::Frame> items = frames_of(peer.sent);
  ASSERT_EQ(items.size(), 1u);
  EXPECT_EQ(items[0].failure().code(), "unavailable");
  EXPECT_NE(items[0].failure().message().find("'pc1'"), std::string::npos);
}

}  // namespace
}  // namespace dssm::daemon
