// SPDX-License-Identifier: Apache-2.0
//
// The local protocol without a socket: what each request answers, who hears of events, what happens
// to a client that breaks the rules, and what waits while dssmd recovers.
#include "daemon/local/local_service.hpp"

#include <gtest/gtest.h>

#include "tests/unit/daemon/local/fake_client.hpp"

namespace dssm::daemon {
namespace {

// --- the rules

TEST(LocalService, WelcomesAProgramThatSpeaksItsVersion) {
  LocalDaemon daemon;
  FakeClient client(daemon.service, 5);
  local::Request hello;
  hello.mutable_hello()->set_protocol_version(wire::kLocalProtocolVersion);
  const local::Response response = client.ask(hello);
  EXPECT_EQ(response.serial(), 1u);
  EXPECT_EQ(response.hello().host(), "pc1");
  EXPECT_EQ(response.hello().version(), DSSM_VERSION);
}

TEST(LocalService, RefusesAVersionFromTheFutureAndNamesBoth) {
  LocalDaemon daemon;
  FakeClient client(daemon.service, 5);
  local::Request hello;
  hello.set_serial(9);
  hello.mutable_hello()->set_protocol_version(77);
  EXPECT_FALSE(client.put(hello)) << "the connection must end";
  const local::Response response = client.next();
  EXPECT_EQ(response.serial(), 9u);
  EXPECT_EQ(response.failure().code(), "protocol");
  EXPECT_NE(response.failure().message().find("version 77"), std::string::npos);
  EXPECT_NE(response.failure().message().find("version 1;"), std::string::npos);
}

TEST(LocalService, EndsAConnectionThatDoesNotBeginWithHello) {
  LocalDaemon daemon;
  FakeClient client(daemon.service, 5);
  local::Request list = list_request();
  list.set_serial(1);
  EXPECT_FALSE(client.put(list));
  EXPECT_EQ(client.next().failure().code(), "protocol");
}

TEST(LocalService, EndsAConnectionThatSendsGarbageOrNoSerial) {
  LocalDaemon daemon;
  FakeClient client(daemon.service, 5);
  client.greet();
  EXPECT_FALSE(client.put(list_request())) << "serial 0";
  EXPECT_EQ(client.next().failure().code(), "protocol");
  const std::string garbage(100, '\xff');
  FakeClient other(daemon.service, 6);
  DescriptorQueue none;
  EXPECT_FALSE(daemon.service.on_frame_untrusted(2, std::as_bytes(std::span(garbage)), none));
  EXPECT_EQ(other.next().serial(), 0u) << "last words belong to no request";
}

TEST(LocalService, AnswersAnUnknownRequestAndContinues) {
  LocalDaemon daemon;
  FakeClient client(daemon.service, 5);
  client.greet();
  local::Request unknown;  // a later version's request arrives as one without a body
  EXPECT_EQ(client.ask(unknown).failure().code(), "protocol");
  EXPECT_TRUE(client.ask(list_request()).has_stream_list());
}

TEST(LocalService, CutsTheProgramsNameToWhatPeopleCanRead) {
  LocalDaemon daemon;
  FakeClient client(daemon.service, 5);
  local::Request hello;
  hello.mutable_hello()->set_protocol_version(wire::kLocalProtocolVersion);
  hello.mutable_hello()->set_program(std::string(126, 'x') + "\xc3\xa4\n" + std::string(500, 'y'));
  EXPECT_TRUE(client.ask(hello).has_hello());
  local::Request list;
  list.mutable_list_clients();
  EXPECT_EQ(client.ask(list).client_list().clients(0).program(), std::string(126, 'x'));
}

// --- requests

TEST(LocalService, CreatesOpensListsAndClosesStreams) {
  LocalDaemon daemon;
  FakeClient writer(daemon.service, 5), reader(daemon.service, 6);
  writer.greet(), reader.greet();
  const local::Response created = writer.ask(create_request("odometry"));
  EXPECT_TRUE(created.opened().created());
  EXPECT_EQ(created.opened().stream().id().host(), "pc1");
  EXPECT_EQ(writer.last_descriptors.size(), 4u);
  EXPECT_FALSE(writer.ask(create_request("odometry")).opened().created());
  const local::Response opened = reader.ask(open_request("odometry"));
  EXPECT_EQ(reader.last_descriptors.size(), 3u);
  EXPECT_EQ(opened.opened().stream().type().name(), "Odometry");

  const local::Response list = reader.ask(list_request());
  ASSERT_EQ(list.stream_list().streams_size(), 1);
  EXPECT_EQ(list.stream_list().streams(0).writers(), 2u);
  EXPECT_EQ(list.stream_list().streams(0).readers(), 1u);
  EXPECT_EQ(list.stream_list().streams(0).users_size(), 0);

  local::Request info;
  info.mutable_info()->mutable_id()->set_name("odometry");
  const local::Response answer = reader.ask(info);
  ASSERT_EQ(answer.stream_list().streams_size(), 1);
  ASSERT_EQ(answer.stream_list().streams(0).users_size(), 3);
  EXPECT_EQ(answer.stream_list().streams(0).users(2).pid(), 6);
  EXPECT_FALSE(answer.stream_list().streams(0).users(2).writer());

  local::Request opens;
  opens.mutable_list_opens();
  const local::Response entries = reader.ask(opens);
  ASSERT_EQ(entries.open_list().opens_size(), 3);
  EXPECT_EQ(entries.open_list().opens(0).tag(), 7u);
  EXPECT_TRUE(entries.open_list().opens(0).for_writing());
  EXPECT_EQ(entries.open_list().opens(2).creator_pid(), 5);
  EXPECT_EQ(entries.open_list().opens(2).opener_pid(), 6);

  local::Request close;
  close.mutable_close()->set_handle(opened.opened().handle());
  EXPECT_TRUE(reader.ask(close).has_done());
  EXPECT_EQ(reader.ask(close).failure().code(), "not_found");
  EXPECT_EQ(reader.ask(list_request()).stream_list().streams(0).readers(), 0u);
}

TEST(LocalService, ReportsWhyAStreamCannotBeCreatedOrOpened) {
  LocalDaemon daemon;
  FakeClient client(daemon.service, 5);
  client.greet();
  EXPECT_EQ(client.ask(open_request("nowhere")).failure().code(), "not_found");
  EXPECT_EQ(client.ask(create_request("a:b")).failure().code(), "invalid_argument");
  EXPECT_EQ(client.ask(create_request(std::string(32, 'x'))).failure().code(), "invalid_argument");
  local::Request request = create_request("x");
  request.mutable_create()->set_cycle_ns(0);
  EXPECT_EQ(client.ask(request).failure().code(), "invalid_argument");
  request = create_request("x");
  request.mutable_create()->set_depth(1);
  EXPECT_TRUE(client.ask(request).has_failure());
  request = create_request("x");
  request.mutable_create()->mutable_type()->set_payload_bytes(0);
  EXPECT_EQ(client.ask(request).failure().code(), "invalid_argument");
  request = create_request("x");
  request.mutable_create()->set_depth(1 << 22);
  EXPECT_EQ(client.ask(request).failure().code(), "limit_exceeded");
  EXPECT_TRUE(daemon.registry.streams().empty());
}

TEST(LocalService, ForgetsTheOpensOfAClientThatLeavesAndKeepsItsStreams) {
  LocalDaemon daemon;
  FakeClient watcher(daemon.service, 5);
  watcher.greet();
  {
    FakeClient client(daemon.service, 6);
    client.greet();
    client.ask(create_request("odometry"));
  }
  const local::Response list = watcher.ask(list_request());
  ASSERT_EQ(list.stream_list().streams_size(), 1);
  EXPECT_EQ(list.stream_list().streams(0).writers(), 0u);
  EXPECT_EQ(daemon.service.clients(), 1u);
}

TEST(LocalService, RefusesMoreOpensThanTheLimitBeforeItCreatesAnything) {
  LocalDaemon daemon(false, {.max_opens = 10, .max_opens_per_client = 1});
  FakeClient client(daemon.service, 5);
  client.greet();
  client.ask(create_request("a"));
  const local::Response refused = client.ask(create_request("b"));
  EXPECT_EQ(refused.failure().code(), "limit_exceeded");
  EXPECT_NE(refused.failure().message().find("max_opens_per_client = 1"), std::string::npos);
  EXPECT_EQ(daemon.registry.streams().size(), 1u);
}

TEST(LocalService, KeepsAndGivesProperties) {
  LocalDaemon daemon;
  FakeClient client(daemon.service, 5);
  client.greet();
  client.ask(create_request("odometry"));
  local::Request set, get;
  set.mutable_set_property()->mutable_id()->set_name("odometry");
  set.mutable_set_property()->set_property(std::string("a\0b", 3));
  get.mutable_get_property()->mutable_id()->set_name("odometry");
  EXPECT_EQ(client.ask(get).property().property(), "");
  EXPECT_TRUE(client.ask(set).has_done());
  EXPECT_EQ(client.ask(get).property().property(), std::string("a\0b", 3));
}

TEST(LocalService, NotifiesWatchersOfExistingStreamsAndOfChanges) {
  LocalDaemon daemon;
  FakeClient client(daemon.service, 5), watcher(daemon.service, 6);
  client.greet(), watcher.greet();
  client.ask(create_request("a"));
  local::Request watch;
  watch.mutable_watch();
  const local::Response there = watcher.ask(watch);
  EXPECT_EQ(there.serial(), 0u);
  EXPECT_EQ(there.stream_event().stream().id().name(), "a");
  EXPECT_TRUE(watcher.next().has_done()) << "the answer comes when all has been told";
  local::Request plain = create_request("b");
  plain.mutable_create()->mutable_type()->clear_name();
  plain.mutable_create()->mutable_type()->clear_fields();
  client.ask(plain);
  const local::Response added = watcher.next();
  EXPECT_EQ(added.serial(), 0u);
  EXPECT_FALSE(added.stream_event().removed());
  EXPECT_EQ(added.stream_event().stream().id().name(), "b");
  client.ask(create_request("b"));
  EXPECT_NE(watcher.next().stream_event().stream().type().name(), "") << "it is described now";
  local::Request remove;
  remove.mutable_remove()->mutable_id()->set_name("a");
  client.ask(remove);
  const local::Response removed = watcher.next();
  EXPECT_TRUE(removed.stream_event().removed());
  EXPECT_EQ(removed.stream_event().stream().id().name(), "a");
  EXPECT_TRUE(watcher.received.empty());
  EXPECT_TRUE(client.received.empty()) << "who does not watch hears nothing";
}

TEST(LocalService, ServesOnlyChangesToAClientThatReceivesNothing) {
  LocalDaemon daemon;
  FakeClient client(daemon.service, 5);
  client.greet();
  client.ask(create_request("a"));
  client.stop_reading();
  local::Request request = list_request();
  request.set_serial(7);
  EXPECT_TRUE(client.put(request));
  request.mutable_watch();
  EXPECT_TRUE(client.put(request));
  request = create_request("b");
  request.set_serial(7);
  EXPECT_TRUE(client.put(request));
  EXPECT_TRUE(client.received.empty());
  EXPECT_FALSE(daemon.registry.knows({"b", 0, ""}));
  request.mutable_set_property()->mutable_id()->set_name("a");
  request.mutable_set_property()->set_property("x");
  EXPECT_TRUE(client.put(request));
  EXPECT_EQ((*daemon.registry.find({"a", 0, ""}))->property().value(), "x");
}

TEST(LocalService, EndsTheWatchOfAClientThatStopsReadingWhileItIsTold) {
  LocalDaemon daemon;
  FakeClient client(daemon.service, 5), watcher(daemon.service, 6);
  client.greet(), watcher.greet();
  local::Request watch;
  watch.mutable_watch();
  EXPECT_TRUE(watcher.ask(watch).has_done());
  client.ask(create_request("a"));
  watcher.ends_at_next = true;  // an event of a change
  EXPECT_FALSE(watcher.take_turn());
  FakeClient late(daemon.service, 7);
  late.greet().ends_at_next = true;  // one of the streams that exist
  watch.set_serial(2);
  EXPECT_TRUE(late.put(watch));
  EXPECT_FALSE(late.take_turn());
  client.ask(create_request("b"));
  EXPECT_FALSE(watcher.wants_turn || late.wants_turn) << "they do not watch any more";
}

TEST(LocalService, TellsManyStreamsInParts) {
  constexpr int kStreams = 2 * LocalService::kStreamsPerTurn + 1;
  LocalDaemon daemon;
  FakeClient client(daemon.service, 5), watcher(daemon.service, 6);
  client.greet(), watcher.greet();
  const auto name = [](int number) { return "s" + std::to_string(number); };
  for (int i = 0; i < kStreams; ++i) {
    ASSERT_TRUE(daemon.registry.create({name(i), 0, ""}, odometry_type(), kHistory, 1));
  }
  local::Request watch;
  watch.set_serial(2);
  watch.mutable_watch();
  ASSERT_TRUE(watcher.put(watch));
  ASSERT_EQ(watcher.received.size(), std::size_t{LocalService::kStreamsPerTurn});
  for (int i = 0; i < LocalService::kStreamsPerTurn; ++i) {
    EXPECT_EQ(watcher.next().stream_event().stream().id().name(), name(i));
  }

  // Changes come first: of a stream that has been told, of one that has not, and of a new one.
  local::Request remove;
  for (const int gone : {0, kStreams - 1}) {
    remove.mutable_remove()->mutable_id()->set_name(name(gone));
    client.ask(remove);
  }
  client.ask(create_request("new"));
  EXPECT_TRUE(watcher.received.empty()) << "it was not its turn";
  ASSERT_TRUE(watcher.take_turn());
  EXPECT_EQ(watcher.received.size(), std::size_t{3 + LocalService::kStreamsPerTurn});
  for (const int gone : {0, kStreams - 1}) {
    const local::Response removed = watcher.next();
    EXPECT_TRUE(removed.stream_event().removed());
    EXPECT_EQ(removed.stream_event().stream().id().name(), name(gone));
  }
  EXPECT_EQ(watcher.next().stream_event().stream().id().name(), "new");
  EXPECT_FALSE(watcher.take_turn());
  for (int i = LocalService::kStreamsPerTurn; i < kStreams - 1; ++i) {
    EXPECT_EQ(watcher.next().stream_event().stream().id().name(), name(i));
  }
  EXPECT_EQ(watcher.next().stream_event().stream().id().name(), "new");
  EXPECT_EQ(watcher.next().serial(), 2u) << "the answer, when all has been told";
  EXPECT_TRUE(watcher.received.empty());
}

// There may be thousands that watch, and one that changes something must not stop all others.
TEST(LocalService, TellsEachWatchOfChangesInItsTurn) {
  LocalDaemon daemon;
  FakeClient client(daemon.service, 5), one(daemon.service, 6), other(daemon.service, 7);
  local::Request watch, set;
  watch.mutable_watch();
  for (FakeClient* each : {&client, &one, &other}) EXPECT_TRUE(each->greet().ask(watch).has_done());
  constexpr int kStreams = LocalService::kStreamsPerTurn;
  for (int i = 0; i < kStreams; ++i) {
    EXPECT_TRUE(client.ask(create_request("s" + std::to_string(i))).has_stream_event());
    EXPECT_TRUE(client.next().has_opened()) << "the answer comes after the event";
  }
  set.mutable_set_property()->mutable_id()->set_name("s0");
  set.mutable_set_property()->set_property("x");
  for (int i = 0; i < 3; ++i) {
    EXPECT_TRUE(client.ask(set).stream_event().property_set());
    EXPECT_TRUE(client.next().has_done());
  }
  EXPECT_TRUE(one.wants_turn);
  EXPECT_TRUE(one.received.empty());
  EXPECT_TRUE(one.take_turn()) << "one more";
  EXPECT_EQ(one.received.size(), std::size_t{kStreams});
  EXPECT_FALSE(one.take_turn());
  EXPECT_EQ(one.received.size(), std::size_t{kStreams + 1}) << "once for three times";
  EXPECT_FALSE(one.received.front().stream_event().property_set());
  EXPECT_TRUE(one.received.back().stream_event().property_set());
  EXPECT_TRUE(other.received.empty());
}

// The queue of a connection has a limit of its own.
TEST(LocalService, KeepsFewChangesForWatchesThatDoNotTakeThem) {
  LocalDaemon daemon(false, {100'000, 100'000});
  FakeClient client(daemon.service, 5), watcher(daemon.service, 6);
  local::Request watch, remove;
  watch.mutable_watch();
  client.greet();
  EXPECT_TRUE(watcher.greet().ask(watch).has_done());
  local::Request create = create_request("long");
  create.mutable_create()->mutable_type()->mutable_fields(0)->set_name(std::string(30'000, 'f'));
  remove.mutable_remove()->mutable_id()->set_name("long");
  std::size_t events = 0;
  for (; watcher.received.empty(); events += 2) {
    ASSERT_LT(events, LocalService::kMaxNewsBytes / 1000) << "each has more than 1000 bytes";
    ASSERT_TRUE(client.ask(create).has_opened());
    ASSERT_TRUE(client.ask(remove).has_done());
  }
  EXPECT_LT(watcher.received.size(), 10u) << "only the oldest";
  while (watcher.take_turn()) {
  }
  ASSERT_EQ(watcher.received.size(), events);
  for (std::size_t i = 0; i < events; ++i) {
    EXPECT_EQ(watcher.next().stream_event().removed(), i % 2 == 1);
  }
}

TEST(LocalService, TellsFewStreamsAtOnceWhenTheyAreLong) {
  LocalDaemon daemon;
  FakeClient client(daemon.service, 5), watcher(daemon.service, 6);
  client.greet(), watcher.greet();
  for (int i = 0; i < 20; ++i) {
    local::Request create = create_request("s" + std::to_string(i));
    proto::Type& type = *create.mutable_create()->mutable_type();
    const proto::Field field = type.fields(0);
    for (int more = 0; more < 500; ++more) {
      *type.add_fields() = field;
      type.mutable_fields(type.fields_size() - 1)->set_name("f" + std::to_string(more));
    }
    ASSERT_TRUE(client.ask(create).has_opened());
  }
  local::Request watch;
  watch.set_serial(2);
  watch.mutable_watch();
  ASSERT_TRUE(watcher.put(watch));
  std::size_t bytes = 0;
  for (const local::Response& event : watcher.received) bytes += event.ByteSizeLong();
  EXPECT_GT(bytes, LocalService::kStreamBytesPerTurn);
  EXPECT_LT(bytes, LocalService::kStreamBytesPerTurn * 2);
  while (watcher.take_turn()) {
  }
  EXPECT_EQ(watcher.received.size(), 21u);
}

TEST(LocalService, ListsProgramsInTheOrderTheyCame) {
  LocalDaemon daemon;
  FakeClient one(daemon.service, 11), two(daemon.service, 12), silent(daemon.service, 13);
  two.greet(), one.greet();
  local::Request list;
  list.mutable_list_clients();
  const local::Response response = one.ask(list);
  ASSERT_EQ(response.client_list().clients_size(), 2) << "only those who said hello";
  EXPECT_EQ(response.client_list().clients(0).pid(), 11);
  EXPECT_EQ(response.client_list().clients(1).pid(), 12);
  EXPECT_EQ(response.client_list().clients(1).uid(), 1000u);
}

TEST(LocalService, LeavesOutFieldsWhenAListHasManyOfThem) {
  LocalDaemon daemon(false, {.max_opens = 1000, .max_opens_per_client = 1000});
  FakeClient client(daemon.service, 5);
  client.greet();
  const auto create = [&](std::size_t from, std::size_t to) {
    for (std::size_t i = from; i < to; ++i) {
      local::Request request = create_request("s");
      request.mutable_create()->mutable_id()->set_id(static_cast<std::int32_t>(i));
      proto::Type& type = *request.mutable_create()->mutable_type();
      for (const char* more : {"third", "fourth"}) {
        proto::Field& field = *type.add_fields();
        field = type.fields(0);
        field.set_name(more);
      }
      const local::Response created = client.ask(request);
      ASSERT_TRUE(created.has_opened()) << created.failure().message();
    }
  };
  constexpr std::size_t kEnough = CatalogRequests::kMaxListedFields / 4;  // with four fields each
  create(0, kEnough);
  EXPECT_EQ(client.ask(list_request()).stream_list().streams(0).type().fields_size(), 4);
  create(kEnough, kEnough + 1);
  const local::Response list = client.ask(list_request());
  ASSERT_EQ(list.stream_list().streams_size(), static_cast<int>(kEnough) + 1);
  for (const proto::Stream& stream : list.stream_list().streams()) {
    EXPECT_EQ(stream.type().fields_size(), 0);
    EXPECT_EQ(stream.type().name(), "Odometry");
  }
}

TEST(LocalService, LeavesOutFieldsWhenTheyMakeAListTooLongForAFrame) {
  LocalDaemon daemon(false, {.max_opens = 1000, .max_opens_per_client = 1000});
  FakeClient client(daemon.service, 5);
  client.greet();
  constexpr int kStreams = 300;  // with 60 KB of field names each: 18 MB
  for (int i = 0; i < kStreams; ++i) {
    local::Request request = create_request("s");
    request.mutable_create()->mutable_id()->set_id(i);
    request.mutable_create()->mutable_type()->mutable_fields(0)->set_name(std::string(60'000, 'f'));
    ASSERT_TRUE(client.ask(request).has_opened());
  }
  const local::Response list = client.ask(list_request());  // fails on a frame that is too long
  ASSERT_EQ(list.stream_list().streams_size(), kStreams);
  EXPECT_EQ(list.stream_list().streams(0).type().fields_size(), 0);
}

TEST(LocalService, GivesBackLongProperties) {
  LocalDaemon daemon;
  FakeClient client(daemon.service, 5);
  client.greet();
  ASSERT_TRUE(client.ask(create_request("s")).has_opened());
  for (const std::size_t bytes : {0U, 1U, 127U, 128U, 65'500U, 65'536U, 70'000U, 1U << 20}) {
    std::string property(bytes, 'p');
    for (std::size_t i = 0; i < bytes; i += 1000) property[i] = static_cast<char>(i / 1000);
    local::Request request;
    request.mutable_set_property()->mutable_id()->set_name("s");
    request.mutable_set_property()->set_property(property);
    const local::Response set = client.ask(request);
    ASSERT_TRUE(set.has_done()) << bytes << " " << set.failure().message();
    request.mutable_get_property()->mutable_id()->set_name("s");
    const local::Response got = client.ask(request);
    if (bytes == 0) {
      EXPECT_EQ(got.failure().code(), "not_found");
    } else {
      EXPECT_TRUE(got.property().property() == property) << bytes;
    }
  }
}

TEST(LocalService, HandsOutOneAndTheSamePlaybackClock) {
  LocalDaemon daemon;
  FakeClient one(daemon.service, 5), two(daemon.service, 6);
  one.greet(), two.greet();
  local::Request request;
  request.mutable_open_clock();
  EXPECT_TRUE(one.ask(request).has_clock());
  EXPECT_TRUE(two.ask(request).has_clock());
  ASSERT_EQ(one.last_descriptors.size(), 1u);
  ASSERT_EQ(two.last_descriptors.size(), 1u);
  EXPECT_TRUE(same_file(one.last_descriptors[0].get(), two.last_descriptors[0].get()));
}

TEST(LocalService, TakesBackAPlaybackClockOnlyBeforeItHandedOneOut) {
  UniqueFd kept;
  {
    LocalDaemon before;
    kept = *before.clock.get();
  }
  LocalDaemon daemon;
  FakeClient client(daemon.service, 5);
  client.greet();
  local::Request offer;
  offer.mutable_open_clock()->set_offered(true);
  EXPECT_EQ(client.ask(offer).failure().code(), "protocol") << "it comes without its descriptor";
  client.offered.emplace_back().push_back(UniqueFd(::open("/dev/null", O_RDWR | O_CLOEXEC)));
  EXPECT_EQ(client.ask(offer).failure().code(), "protocol");
  client.offered.emplace_back().push_back(copy_of(kept));
  EXPECT_TRUE(client.ask(offer).has_clock());
  EXPECT_TRUE(same_file(client.last_descriptors[0].get(), kept.get()));

  LocalDaemon in_use;
  FakeClient other(in_use.service, 6);
  other.greet();
  local::Request plain;
  plain.mutable_open_clock();
  EXPECT_TRUE(other.ask(plain).has_clock());
  other.offered.emplace_back().push_back(copy_of(kept));
  EXPECT_TRUE(other.ask(offer).has_clock());
  EXPECT_FALSE(same_file(other.last_descriptors[0].get(), kept.get()));
}

TEST(LocalService, DescribesItself) {
  LocalDaemon daemon;
  FakeClient client(daemon.service, 5);
  client.greet();
  client.ask(create_request("odometry"));
  local::Request request;
  request.mutable_get_daemon();
  const local::Response response = client.ask(request);
  EXPECT_EQ(response.daemon().host(), "pc1");
  EXPECT_EQ(response.daemon().streams(), 1u);
  EXPECT_EQ(response.daemon().memory_limit_bytes(), kLimits.max_memory_bytes);
  EXPECT_GT(response.daemon().memory_bytes(), 16u * 24);
  EXPECT_EQ(response.daemon().mdns().phase(), local::Mdns::OFF);  // without a network
}

TEST(LocalService, ListsTheLimitsOfAllParts) {
  LocalDaemon daemon;
  daemon.service.set_facts_source([&] {
    DaemonFacts facts;
    facts.config_file = "/etc/dssm/dssmd.conf";
    facts.clock_policy = ClockPolicy::mark;
    daemon.registry.add_limits(facts.limits);
    daemon.opens.add_limits(facts.limits);
    return facts;
  });
  FakeClient client(daemon.service, 5), other(daemon.service, 6);
  client.greet();
  other.greet();
  client.ask(create_request("odometry"));
  client.ask(create_request("odometry"));
  other.ask(create_request("odometry"));
  local::Request request;
  request.mutable_get_daemon();
  std::string limits;
  const local::Response response = client.ask(request);
  for (const local::LimitUse& one : response.daemon().limits()) {
    if (one.name().starts_with("max_memory")) {  // all of it is that of one user
      EXPECT_EQ(one.used(), response.daemon().memory_bytes());
      continue;
    }
    limits += one.name() + " " + std::to_string(one.used()) + " of " + std::to_string(one.limit()) +
              " " + one.unit() + "\n";
  }
  EXPECT_EQ(response.daemon().config_file(), "/etc/dssm/dssmd.conf");
  EXPECT_EQ(response.daemon().clock_policy(), "mark");
  EXPECT_EQ(limits,
            "max_streams 1 of 400 streams\n"
            "max_streams of one user or host 1 of 400 streams\n"
            "max_opens 3 of 1000 open streams\n"
            "max_opens of one user 3 of 1000 open streams\n"
            "max_opens_per_client 2 of 100 open streams\n");
}

// --- a stream that exists already

local::Request sized_request(const std::string& name, std::uint64_t payload_bytes,
                             std::uint64_t depth) {
  local::Request request = create_request(name);
  wire::to_message(TypeInfo{"", payload_bytes, 1, {}}, *request.mutable_create()->mutable_type());
  request.mutable_create()->set_depth(depth);
  return request;
}

TEST(LocalService, ReplacesARingThatNoProgramHasOpen) {
  LocalDaemon daemon;
  std::uint64_t before = 0;
  const auto ask = [&](std::uint64_t bytes, std::uint64_t depth) {
    FakeClient program(daemon.service, 5);
    program.greet();
    const proto::Opened opened = program.ask(sized_request("s", bytes, depth)).opened();
    EXPECT_EQ(daemon.registry.streams().size(), 1u);
    const Stream& stream = *daemon.registry.streams().front();
    EXPECT_EQ(opened.created(), stream.incarnation() != before);
    before = stream.incarnation();
    return opened.created();
  };
  EXPECT_TRUE(ask(24, 16));
  EXPECT_FALSE(ask(24, 16)) << "as it was";
  EXPECT_FALSE(ask(24, 4)) << "it holds more than is asked for";
  EXPECT_TRUE(ask(24, 17)) << "it holds less";
  EXPECT_TRUE(ask(25, 17)) << "another type";
}

TEST(LocalService, LeavesTheRingWhenTheNewOneCannotBeMade) {
  LocalDaemon daemon;
  FakeClient client(daemon.service, 6);
  client.greet();
  ASSERT_TRUE(daemon.registry.create({"s", 0, ""}, {"", 24, 1, {}}, {16, Duration(1)}, 1));
  const std::uint64_t before = daemon.registry.streams().front()->incarnation();
  EXPECT_EQ(client.ask(sized_request("s", 25, 1)).failure().code(), "invalid_argument");
  EXPECT_EQ(client.ask(sized_request("s", 25, kLimits.max_memory_bytes / 25)).failure().code(),
            "limit_exceeded");
  ASSERT_EQ(daemon.registry.streams().size(), 1u);
  EXPECT_EQ(daemon.registry.streams().front()->incarnation(), before);
}

TEST(LocalService, NamesThoseThatHaveARingOpenThatDoesNotFit) {
  LocalDaemon daemon;
  FakeClient user(daemon.service, 5), client(daemon.service, 6);
  user.greet(), client.greet();
  ASSERT_TRUE(user.ask(sized_request("s", 24, 16)).has_opened());
  const proto::Failure type = client.ask(sized_request("s", 25, 16)).failure();
  EXPECT_EQ(type.code(), "type_mismatch");
  EXPECT_NE(type.message().find("the stream carries 24 bytes"), std::string::npos);
  EXPECT_NE(type.message().find("open in 'test' (pid 5)"), std::string::npos) << type.message();
  EXPECT_NE(type.message().find("dssmctl rm s:0@pc1"), std::string::npos) << type.message();
  const proto::Failure history = client.ask(sized_request("s", 24, 17)).failure();
  EXPECT_EQ(history.code(), "conflict");
  EXPECT_NE(history.message().find("its ring has 16 slots, and this program asks for 17"),
            std::string::npos)
      << history.message();
}

TEST(LocalService, KeepsAnExistingRingOnRequest) {
  LocalDaemon daemon;
  FakeClient client(daemon.service, 6);
  client.greet();
  ASSERT_TRUE(daemon.registry.create({"s", 0, ""}, {"", 24, 1, {}}, {16, Duration(1)}, 1));
  local::Request longer = sized_request("s", 24, 99), other = sized_request("s", 25, 16);
  longer.mutable_create()->set_keep_existing(true);
  other.mutable_create()->set_keep_existing(true);
  EXPECT_EQ(client.ask(other).failure().code(), "type_mismatch");
  const local::Response joined = client.ask(longer);
  ASSERT_TRUE(joined.has_opened());
  EXPECT_FALSE(joined.opened().created());
}

TEST(LocalService, ReplacesNothingWhileItDoesNotKnowWhoHasWhatOpen) {
  LocalDaemon daemon;
  FakeClient client(daemon.service, 6);
  client.greet();
  ASSERT_TRUE(daemon.registry.create({"s", 0, ""}, {"", 24, 1, {}}, {16, Duration(1)}, 1));
  daemon.registry.begin_recovery(Registry::Recovery::opens);
  const proto::Failure refused = client.ask(sized_request("s", 25, 16)).failure();
  EXPECT_EQ(refused.code(), "type_mismatch");
  EXPECT_NE(refused.message().find("try again in a second"), std::string::npos);
  EXPECT_TRUE(client.ask(sized_request("new", 25, 16)).has_opened()) << "nothing else waits";
  daemon.registry.end_recovery();
  EXPECT_TRUE(client.ask(sized_request("s", 25, 16)).opened().created());
}

// --- rights

TEST(LocalService, LetsOnlyTheProgramThatCreatedAStreamRemoveIt) {
  LocalDaemon daemon;
  daemon.rights.set({parse_right("user:4711 create s").value(),  //
                     parse_right("user:4712 write s").value()});
  local::Request remove;
  remove.mutable_remove()->mutable_id()->set_name("s");
  ASSERT_TRUE(FakeClient(daemon.service, 5, 4711).greet().ask(create_request("s")).has_opened());
  {
    FakeClient same_pid(daemon.service, 5, 4712);  // when the creator has ended
    ASSERT_TRUE(same_pid.greet().ask(open_request("s", true)).has_opened());
    EXPECT_EQ(same_pid.ask(remove).failure().code(), "no_permission");
  }
  {
    FakeClient other(daemon.service, 6, 4711);
    ASSERT_TRUE(other.greet().ask(open_request("s", true)).has_opened());
    EXPECT_EQ(other.ask(remove).failure().code(), "no_permission");
  }
  FakeClient creator(daemon.service, 5, 4711);
  ASSERT_TRUE(creator.greet().ask(open_request("s", true)).has_opened());
  EXPECT_TRUE(creator.ask(remove).has_done());
}

// Which has no pid, as a program of another pid namespace.
TEST(LocalService, TakesNoProgramForTheCreatorOfAStreamOfAnotherHost) {
  LocalDaemon daemon;
  daemon.rights.set({parse_right("user:4711 write s").value()});
  ASSERT_TRUE(daemon.registry.create({"s", 0, ""}, odometry_type(), kHistory, 0, "host 'pc2'"));
  FakeClient of_other_namespace(daemon.service, 0, 4711);
  ASSERT_TRUE(of_other_namespace.greet().ask(open_request("s", true)).has_opened());
  local::Request remove;
  remove.mutable_remove()->mutable_id()->set_name("s");
  EXPECT_EQ(of_other_namespace.ask(remove).failure().code(), "no_permission");
}

TEST(LocalService, TakesNoDescriptionFromAProgramThatMayOnlyWrite) {
  LocalDaemon daemon;
  const TypeInfo type = odometry_type();
  const auto stream =
      daemon.registry.create({"odometry", 0, ""}, {"", type.payload_bytes, 1, {}}, kHistory, 1);
  ASSERT_TRUE(stream);
  FakeClient program(daemon.service, 6, 4711);
  program.greet();
  daemon.rights.set({parse_right("user:4711 write odometry").value()});
  EXPECT_TRUE(program.ask(create_request("odometry")).has_opened());
  EXPECT_EQ(stream->stream->type().name, "");
  EXPECT_EQ(program.ask(sized_request("odometry", 25, 16)).failure().code(), "type_mismatch");
  for (const char* verb : {"create", "property"}) {
    daemon.rights.set({parse_right("user:4711 write odometry").value(),
                       parse_right(std::string("user:4711 ") + verb + " odometry").value()});
    ASSERT_TRUE(daemon.registry.remove({"odometry", 0, ""}));
    const auto fresh =
        daemon.registry.create({"odometry", 0, ""}, {"", type.payload_bytes, 1, {}}, kHistory, 1);
    EXPECT_TRUE(program.ask(create_request("odometry")).has_opened());
    EXPECT_EQ(fresh->stream->type(), type) << verb;
  }
}

// --- recovery

// A client's answer to a Create by an earlier dssmd: what it can offer now.
std::vector<UniqueFd> descriptors_from_before(const std::string& name) {
  LocalDaemon before;
  FakeClient client(before.service, 5);
  client.greet();
  EXPECT_TRUE(client.ask(create_request(name)).has_opened());
  return std::move(client.last_descriptors);
}

local::Request offer_request(const std::string& name) {
  local::Request request;
  request.mutable_offer()->mutable_id()->set_name(name);
  request.mutable_offer()->set_for_writing(true);
  return request;
}

TEST(LocalService, DelaysRequestsForAStreamThatMayStillBeOffered) {
  std::vector<UniqueFd> kept = descriptors_from_before("odometry");
  const UniqueFd ring = copy_of(kept[0]);
  LocalDaemon daemon(true);
  FakeClient fresh(daemon.service, 6), old(daemon.service, 5);
  fresh.greet(), old.greet();
  local::Request create = create_request("odometry");
  create.set_serial(50);
  ASSERT_TRUE(fresh.put(create));
  EXPECT_TRUE(fresh.received.empty()) << "neither done nor refused";
  EXPECT_TRUE(fresh.ask(list_request()).has_stream_list()) << "all else goes on";

  old.offered.push_back(std::move(kept));
  const local::Response offered = old.ask(offer_request("odometry"));
  EXPECT_TRUE(offered.has_opened()) << offered.failure().message();
  EXPECT_TRUE(old.last_descriptors.empty());
  const local::Response joined = fresh.next();
  EXPECT_EQ(joined.serial(), 50u);
  EXPECT_FALSE(joined.opened().created());
  EXPECT_TRUE(same_file(fresh.last_descriptors.at(0).get(), ring.get())) << "the old ring";
}

TEST(LocalService, AnswersWhatWaitsWhenRecoveryEnds) {
  LocalDaemon daemon(true);
  FakeClient client(daemon.service, 6);
  client.greet();
  local::Request create = create_request("odometry"), open = open_request("lidar");
  create.set_serial(50), open.set_serial(51);
  ASSERT_TRUE(client.put(create) && client.put(open));
  EXPECT_TRUE(client.received.empty());
  daemon.registry.end_recovery();
  EXPECT_TRUE(client.next().opened().created());
  const local::Response refused = client.next();
  EXPECT_EQ(refused.serial(), 51u);
  EXPECT_EQ(refused.failure().code(), "not_found");
  EXPECT_TRUE(client.ask(create_request("next")).has_opened()) << "at once from now on";
}

TEST(LocalService, RefusesAtOnceWhatNoOfferCouldFix) {
  LocalDaemon daemon(true);
  FakeClient client(daemon.service, 6);
  client.greet();
  EXPECT_EQ(client.ask(create_request("a:b")).failure().code(), "invalid_argument");
}

TEST(LocalService, ForgetsWhatAClientWaitedForWhenItLeaves) {
  LocalDaemon daemon(true);
  {
    FakeClient client(daemon.service, 6);
    client.greet();
    local::Request create = create_request("odometry");
    create.set_serial(50);
    ASSERT_TRUE(client.put(create));
  }
  daemon.registry.end_recovery();
  EXPECT_TRUE(daemon.registry.streams().empty());
}

TEST(LocalService, BoundsWhatOneClientHasWaiting) {
  LocalDaemon daemon(true);
  FakeClient client(daemon.service, 6);
  client.greet();
  local::Request create = create_request("odometry");
  create.mutable_create()->mutable_type()->mutable_fields(0)->set_name(std::string(200'000, 'f'));
  for (std::uint64_t serial = 50; serial < 60 && client.received.empty(); ++serial) {
    create.set_serial(serial);
    ASSERT_TRUE(client.put(create));
  }
  EXPECT_EQ(client.next().failure().code(), "limit_exceeded");
}

// Each request counts as more than its few bytes.
TEST(LocalService, BoundsWhatOneUserHasWaiting) {
  LocalDaemon daemon(true);
  constexpr std::size_t kFew = LocalService::kMaxDeferredBytes / LocalService::kDeferredBytes / 2;
  constexpr std::size_t kPrograms =
      2 * LocalService::kMaxDeferredBytesPerUser / LocalService::kMaxDeferredBytes;
  std::deque<FakeClient> clients;
  local::Request create = create_request("odometry");
  do {
    FakeClient& client = clients.emplace_back(daemon.service, 6).greet();
    for (std::uint64_t serial = 50; serial < 50 + kFew; ++serial) {
      create.set_serial(serial);
      ASSERT_TRUE(client.put(create));
    }
  } while (clients.back().received.empty() && clients.size() <= kPrograms);
  EXPECT_GE(clients.size(), kPrograms * 3 / 4);
  EXPECT_NE(clients.back().next().failure().message().find("16 MiB"), std::string::npos);
}

TEST(LocalService, AnswersWhatWaitsInTurns) {
  LocalDaemon daemon(true);
  FakeClient client(daemon.service, 6);
  client.greet();
  local::Request create = create_request("odometry");
  for (std::uint64_t serial = 50; serial < 53; ++serial) {
    create.set_serial(serial);
    ASSERT_TRUE(client.put(create));
  }
  daemon.registry.end_recovery();
  for (std::size_t answered = 1; answered <= 3; ++answered) {
    EXPECT_TRUE(client.take_turn());
    EXPECT_EQ(client.received.size(), answered);
  }
  EXPECT_FALSE(client.take_turn());
}

// A program may have thousands of streams open.
TEST(LocalService, EndsTheOpensOfAClientThatLeavesInParts) {
  LocalDaemon daemon(false, {10'000, 10'000});
  class Output final : public ClientOutput {
    void send(std::string /*bytes*/, std::vector<UniqueFd> /*descriptors*/) override {}
    void request_turn() override {}
  } output;
  const ClientNumber number = daemon.service.connect({}, output);
  auto put = [&, serial = 1U](local::Request request) mutable {
    request.set_serial(serial++);
    const std::string bytes = request.SerializeAsString();
    DescriptorQueue none;
    ASSERT_TRUE(daemon.service.on_frame_untrusted(number, std::as_bytes(std::span(bytes)), none));
  };
  local::Request hello;
  hello.mutable_hello()->set_protocol_version(wire::kLocalProtocolVersion);
  put(hello);
  put(create_request("a"));
  for (std::size_t i = 0; i < 2 * LocalService::kOpensPerTurn; ++i) put(open_request("a"));
  const Stream& stream = **daemon.registry.find({"a", 0, ""});
  EXPECT_EQ(daemon.opens.counts(stream).readers, 2 * LocalService::kOpensPerTurn);
  EXPECT_TRUE(daemon.service.disconnect(number, true));
  EXPECT_EQ(daemon.opens.counts(stream).writers, 0u);
  EXPECT_EQ(daemon.opens.counts(stream).readers, LocalService::kOpensPerTurn + 1);
  EXPECT_TRUE(daemon.service.leave(number, true));
  EXPECT_FALSE(daemon.service.leave(number, true));
  EXPECT_TRUE(daemon.opens.entries().empty());
  EXPECT_EQ(stream.info().crashed_writers, 1u);
}

TEST(LocalService, DelaysRequestsForAPlaybackClockThatMayStillBeOffered) {
  UniqueFd kept;
  {
    LocalDaemon before;
    kept = *before.clock.get();
  }
  LocalDaemon daemon(true);
  FakeClient fresh(daemon.service, 6), old(daemon.service, 5);
  fresh.greet(), old.greet();
  local::Request plain, offer;
  plain.set_serial(50);
  plain.mutable_open_clock();
  offer.mutable_open_clock()->set_offered(true);
  ASSERT_TRUE(fresh.put(plain));
  EXPECT_TRUE(fresh.received.empty());
  old.offered.emplace_back().push_back(copy_of(kept));
  EXPECT_TRUE(old.ask(offer).has_clock());
  EXPECT_TRUE(fresh.next().has_clock());
  EXPECT_TRUE(same_file(fresh.last_descriptors.at(0).get(), kept.get()));
}

TEST(LocalService, RefusesAnOfferWithoutItsDescriptors) {
  LocalDaemon daemon;
  FakeClient client(daemon.service, 6);
  client.greet();
  EXPECT_EQ(client.ask(offer_request("odometry")).failure().code(), "protocol");
  client.offered.emplace_back().push_back(UniqueFd(::open("/dev/null", O_RDWR | O_CLOEXEC)));
  EXPECT_EQ(client.ask(offer_request("odometry")).failure().code(), "protocol");
}

}  // namespace
}  // namespace dssm::daemon
