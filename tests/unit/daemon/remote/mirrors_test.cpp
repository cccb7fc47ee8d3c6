// SPDX-License-Identifier: Apache-2.0
//
// Mirrors against an owner that does what the test says.
#include <gtest/gtest.h>

#include "daemon/remote/mirror.hpp"
#include "tests/unit/daemon/remote/remote_stream_test.hpp"

namespace dssm::daemon {
namespace {

using namespace std::chrono_literals;

class MirrorsTest : public RemoteStreamTest<Mirror> {
 protected:
  std::vector<const Stream*> replaced;

  MirrorsTest() {
    parts.on_ring_replaced = [this](const Stream& old) { replaced.push_back(&old); };
  }

  // Without the history that others have asked for.
  std::shared_ptr<Answer> open_without() {
    auto answer = std::make_shared<Answer>();
    streams->open(
        owner->host(), kOdometry, nullptr,
        [answer](Result<OpenedRing> result) { answer->emplace(std::move(result)); }, {}, false);
    return answer;
  }
  std::shared_ptr<Stream> find() {
    Mirror* mirror = streams->find(kOdometry);
    return mirror ? mirror->acquire() : nullptr;
  }
  std::shared_ptr<Stream> wait(const std::shared_ptr<Answer>& answer) {
    return RemoteStreamTest::wait(answer).stream;
  }
  // From the next connection on.
  void send_newest_first() {
    wire::Greeting greeting = greeting_of("pc2");
    greeting.features.emplace_back(wire::kFeatureNewestFirst);
    owner->greet_as(greeting);
  }
  // Answers Open and Subscribe; returns the latter.
  net::Frame serve(Tid first) {
    const net::Frame open = owner->receive();
    EXPECT_TRUE(open.has_open());
    EXPECT_EQ(open.open().id().name(), kOdometry.name);
    owner->send(opened_frame(open, theirs));
    net::Frame subscribe = owner->receive();
    EXPECT_TRUE(subscribe.has_subscribe());
    owner->send(subscribed_frame(subscribe, theirs.incarnation, first));
    return subscribe;
  }
  void samples(Tid first, Tid last) {
    for (Tid tid = first; tid <= last; ++tid) {
      owner->send_sample({tid, time_from_ns(tid), Duration(1)},
                         Bytes(24, static_cast<std::byte>(tid)));
    }
  }
  // A mirror that is up to date, with samples 0 ... newest.
  std::shared_ptr<Stream> opened(Tid newest) {
    const auto answer = open();
    serve(0);
    samples(0, newest);
    owner->send_caught_up();
    return wait(answer);
  }
  proto::Mirror state() {
    proto::Mirror state;
    streams->find(kOdometry)->describe(state);
    return state;
  }
  void until_state(proto::Mirror::State wanted) {
    run_until(loop, [&] { return state().state() == wanted; });
  }
  static Tid newest(const Stream& stream) { return ring::RingReader(stream.mapping()).newest(); }
  void until_newest(const Stream& stream, Tid tid) {
    run_until(loop, [&] { return newest(stream) >= tid; });
    EXPECT_EQ(newest(stream), tid);
  }
};

TEST_F(MirrorsTest, FillsARingWithTheOwnersHistoryBeforeItAnswers) {
  const auto answer = open();
  const net::Frame subscribe = serve(100);
  EXPECT_TRUE(subscribe.subscribe().from_oldest());
  samples(100, 110);
  run_until(loop, [&] { return find() && newest(*find()) == 110; });
  EXPECT_FALSE(answer->has_value()) << "more may follow";
  EXPECT_EQ(state().state(), proto::Mirror::FILLING);
  owner->send_caught_up();
  const std::shared_ptr<Stream> stream = wait(answer);
  EXPECT_EQ(stream->id(), kOdometry);
  EXPECT_EQ(stream->type(), odometry_type());
  EXPECT_EQ(stream->incarnation(), 7u);
  EXPECT_EQ(stream->purpose(), Purpose::mirror);
  EXPECT_EQ(stream->info().depth, 16u);
  EXPECT_EQ(stream->info().cycle, 10ms);
  EXPECT_EQ(stream->info().oldest, 100);
  EXPECT_EQ(state().state(), proto::Mirror::LIVE);
  EXPECT_EQ(state().received_samples(), 11u);
  EXPECT_EQ(state().received_bytes(), 11u * 24);
  EXPECT_EQ(state().newest(), 110);
}

// --- the owner learns who reads

class MirrorUsersTest : public MirrorsTest {
 protected:
  explicit MirrorUsersTest(bool wanted = true) {
    parts.opens = &opens;
    parts.mirror_linger = 5s;
    if (wanted) greeting.features.emplace_back(wire::kFeatureUsers);
    owner->greet_as(greeting);
  }
  OpenNumber add(std::int32_t pid, std::shared_ptr<Stream> stream) {
    ClientIdentity client;
    client.pid = pid;
    client.uid = 1000;
    client.program = "mapper";
    client.number = static_cast<ClientNumber>(pid);
    const OpenNumber number = opens.add(
        {std::make_shared<const ClientIdentity>(client), std::move(stream), Role::reader});
    find();  // dssmd adds the entry in the same turn in which it gets the stream
    return number;
  }
  // The pids in the next SetUsers, and how many readers there are.
  std::vector<std::int64_t> stated() {
    last = owner->receive();
    EXPECT_TRUE(last.has_set_users()) << last.ShortDebugString();
    std::vector<std::int64_t> numbers;
    for (const proto::User& user : last.set_users().users()) numbers.push_back(user.pid());
    numbers.push_back(last.set_users().readers());
    return numbers;
  }
  void answer_done() {
    net::Frame done = answer_to(last);
    done.mutable_done();
    owner->send(done);
  }
  void no_request() {
    run_turns(loop, 16);
    EXPECT_FALSE(owner->has_request());
  }

  OpenTable opens{{1000, 1000}};
  wire::Greeting greeting = greeting_of("pc2");
  net::Frame last;
};
using Numbers = std::vector<std::int64_t>;

TEST_F(MirrorUsersTest, AreStatedWhenTheyChangeAndAfterAReconnect) {
  const auto first = open();
  serve(0);
  no_request();
  owner->send_caught_up();
  const OpenNumber one = add(5, wait(first));
  first->reset();  // the entry is the only one that holds the stream
  EXPECT_EQ(stated(), (Numbers{5, 1}));
  add(6, find());
  no_request();
  answer_done();
  EXPECT_EQ(stated(), (Numbers{5, 6, 2})) << "what has changed before the answer comes after it";
  answer_done();
  find();
  no_request();
  EXPECT_TRUE(opens.remove(5, one));
  EXPECT_EQ(stated(), (Numbers{6, 1}));

  owner->cut();
  catalog.host_up(greeting, owner->address());
  serve(0);
  EXPECT_EQ(stated(), (Numbers{6, 1}));
  answer_done();
  EXPECT_FALSE(opens.remove_some(6, false, 100));
  EXPECT_EQ(stated(), (Numbers{0}));
}

TEST_F(MirrorUsersTest, AreNamedUpToALimitAndCountedAll) {
  const std::shared_ptr<Stream> stream = opened(0);
  const auto count = static_cast<std::int64_t>(wire::kMaxChannelUsers) + 3;
  for (std::int32_t pid = 1; pid <= count; ++pid) add(pid, stream);
  const Numbers numbers = stated();
  EXPECT_EQ(numbers.size(), wire::kMaxChannelUsers + 1);
  EXPECT_EQ(numbers.back(), count);
}

TEST_F(MirrorUsersTest, AreNotStatedAgainOnAChannelThatRefusesIt) {
  add(5, opened(0));
  stated();
  owner->fail(last, Errc::protocol, "a channel takes no such request");
  add(6, find());
  no_request();
}

struct OlderOwnerTest : MirrorUsersTest {
  OlderOwnerTest() : MirrorUsersTest(false) {}
};
TEST_F(OlderOwnerTest, IsNotNotifiedOfUsers) {
  add(5, opened(0));
  no_request();
}

TEST_F(MirrorsTest, SharesOneChannelAmongAllReaders) {
  const auto first = open(), second = open();
  serve(0);
  owner->send_caught_up();
  EXPECT_EQ(wait(first), wait(second));
  const auto third = open();
  ASSERT_TRUE(third->has_value()) << "it is there";
  EXPECT_EQ(owner->connections(), 1);
  EXPECT_EQ(count(), 1u);
}

TEST_F(MirrorsTest, AnswersWithWhatCameWhenTheHistoryTakesLong) {
  const auto answer = open();
  serve(0);
  samples(0, 3);
  EXPECT_EQ(newest(*wait(answer)), 3);
  EXPECT_EQ(state().state(), proto::Mirror::FILLING);
}

// Others may want it.
TEST_F(MirrorsTest, DoesNotLetThoseWaitForHistoryWhoDidNotAskForIt) {
  send_newest_first();
  const auto recorder = open();
  streams->find(kOdometry)->want_history();
  serve(10);
  const auto early = open_without();
  EXPECT_FALSE(early->has_value()) << "there is no sample yet";
  owner->send_sample({10, {}, {}}, Bytes(24), true);
  run_turns(loop, 300);
  EXPECT_FALSE(open_without()->has_value()) << "it was overwritten while it was sent";
  samples(11, 11);
  run_until(loop, [&] { return find() && newest(*find()) == 11; });
  EXPECT_EQ(state().state(), proto::Mirror::FILLING);
  ASSERT_TRUE(early->has_value()) << "it waited for what it did not ask for";
  EXPECT_EQ(newest(*early->value().value().stream), 11);
  const auto at_once = open_without();
  ASSERT_TRUE(at_once->has_value());
  EXPECT_EQ(newest(*at_once->value().value().stream), 11);
  EXPECT_FALSE(recorder->has_value()) << "the history is still on its way";
  owner->send_caught_up();
  wait(recorder);
}

TEST_F(MirrorsTest, AnswersWhenTheSampleIsHereThatWasNewestWhenTheOwnerWasAsked) {
  send_newest_first();
  const auto early = open_without();
  const net::Frame open = owner->receive();
  owner->send(opened_frame(open, theirs));
  const net::Frame subscribe = owner->receive();
  net::Frame subscribed = subscribed_frame(subscribe, theirs.incarnation, 10);
  subscribed.mutable_subscribed()->set_newest(11);
  owner->send(subscribed);
  samples(10, 10);
  run_until(loop, [&] { return find() && newest(*find()) == 10; });
  run_turns(loop, 16);
  EXPECT_FALSE(early->has_value()) << "a newer one is on its way";
  samples(11, 11);
  run_until(loop, [&] { return early->has_value(); });
  EXPECT_EQ(newest(*early->value().value().stream), 11);
}

TEST_F(MirrorsTest, FetchesHistoryAfterACutOnlyWhileAProgramHoldsItThatWantsItAtOnce) {
  parts.mirror_linger = 5s;
  send_newest_first();
  const auto answer = open();
  Mirror& mirror = *streams->find(kOdometry);
  mirror.want_history();
  EXPECT_FALSE(serve(0).subscribe().from_newest());
  samples(0, 5);
  owner->send_caught_up();
  std::shared_ptr<Stream> held = mirror.with_history(wait(answer));
  mirror.want_history();  // it is here: as another program's open, which ended
  const std::shared_ptr<Stream> other = find();
  const auto is_fetched_after_a_cut = [&](Tid next) {
    owner->cut();
    const net::Frame subscribe = serve(next);
    samples(next, next);
    owner->send_caught_up();
    until_state(proto::Mirror::LIVE);
    return !subscribe.subscribe().from_newest();
  };
  EXPECT_TRUE(is_fetched_after_a_cut(6));
  EXPECT_TRUE(is_fetched_after_a_cut(7)) << "while it holds it";
  held.reset();
  EXPECT_FALSE(is_fetched_after_a_cut(8)) << "nobody wants it any more";
  held = mirror.with_history(other);
  EXPECT_FALSE(owner->receive().subscribe().from_newest()) << "at once";
}

TEST_F(MirrorsTest, FailsWithAReasonWhenTheOwnerDoesNotAnswer) {
  const wire::Address address = owner->address();
  const KnownHost host = owner->host();
  owner.reset();  // no process listens there any more
  const Error error = wait_error(open_at(host));
  EXPECT_EQ(error.code, Errc::unavailable);
  for (const std::string& word :
       {std::string("odometry:0@pc2"), address.str(), std::string("refused")}) {
    EXPECT_NE(error.message.find(word), std::string::npos) << error.message;
  }
  wait_until_none();
}

TEST_F(MirrorsTest, AreChargedToWhoOpensThemFirst) {
  registry.set_limits({.max_streams = 2, .max_memory_bytes = 1 << 20, .max_share = {50}});
  Answer answer;
  streams->open(
      owner->host(), kOdometry, nullptr,
      [&](Result<OpenedRing> result) { answer.emplace(std::move(result)); }, "user 1000");
  serve(0);
  owner->send_caught_up();
  run_until(loop, [&] { return answer.has_value(); });
  const std::shared_ptr<Stream> mirror = answer->value().stream;
  EXPECT_EQ(mirror->account(), "user 1000");
  EXPECT_EQ(registry.budgets().most_used(), registry.budget().used());
  answer.reset();
  streams->open(
      owner->host(), {"other", 0, ""}, nullptr,
      [&](Result<OpenedRing> result) { answer.emplace(std::move(result)); }, "user 1000");
  EXPECT_NE(answer.value().error().message.find("max_share"), std::string::npos)
      << answer->error().message;
}

TEST_F(MirrorsTest, ForwardsTheOwnersRefusal) {
  const auto answer = open();
  owner->fail(owner->receive(), Errc::not_found, "there is no stream 'odometry:0@pc2'");
  EXPECT_EQ(wait_error(answer).code, Errc::not_found);
  wait_until_none();
  EXPECT_EQ(registry.budget().used(), 0u);
}

TEST_F(MirrorsTest, RefusesWhatDoesNotFitIntoItsMemory) {
  theirs.depth = kMaxDepth;
  const auto answer = open();
  owner->send(opened_frame(owner->receive(), theirs));
  run_until(loop, [&] { return answer->has_value(); });
  EXPECT_EQ((*answer)->error().code, Errc::limit_exceeded);
  EXPECT_NE((*answer)->error().message.find("max_memory"), std::string::npos);
  EXPECT_NE((*answer)->error().message.find("key mirror_streams"), std::string::npos);
}

TEST_F(MirrorsTest, CountsTowardsTheStreamsOfThisHost) {
  Registry small("pc1", {.max_streams = 1, .max_memory_bytes = 1 << 20, .max_property_bytes = 1});
  const ChannelParts small_parts{loop, resolver, small, logger, greeting_of("pc1")};
  RemoteStreams<Mirror> few(small_parts, catalog);
  {
    std::optional<Errc> code;
    few.open(owner->host(), kOdometry, nullptr, [&](auto result) {
      code = result ? std::nullopt : std::optional(result.error().code);
    });
    EXPECT_EQ(small.create({"own", 0, ""}, odometry_type(), kHistory, 1).error().code,
              Errc::limit_exceeded);
    few.open(owner->host(), {"other", 0, "pc2"}, nullptr,
             [&](auto result) { code = result.error().code; });
    EXPECT_EQ(code, Errc::limit_exceeded);
    owner->fail(owner->receive(), Errc::not_found, "none");
    run_until(loop, [&] { return !few.find(kOdometry) && !few.find({"other", 0, "pc2"}); });
  }
  EXPECT_TRUE(small.create({"own", 0, ""}, odometry_type(), kHistory, 1));
}

TEST_F(MirrorsTest, ClosesWhenNoProgramUsesItAnyMore) {
  std::shared_ptr<Stream> stream = opened(5);
  std::shared_ptr<Stream> second = find();
  stream.reset();
  event_base_loop(loop.base(), EVLOOP_ONCE | EVLOOP_NONBLOCK);
  EXPECT_TRUE(owner->connected()) << "one uses it still";
  second.reset();
  run_until(loop, [&] { return count() == 0 && !owner->connected(); });
  EXPECT_EQ(registry.budget().used(), 0u);
}

TEST_F(MirrorsTest, StaysForAWhileAfterItsLastUser) {
  parts.mirror_linger = 50ms;
  opened(5).reset();
  auto opened_again = open();
  ASSERT_TRUE(opened_again->has_value()) << "it is there still";
  bool later = false;
  EventSource timer = EventSource::timer(loop, [&] { later = true; });
  timer.enable_in(100ms);
  run_until(loop, [&] { return later; });
  EXPECT_EQ(count(), 1u) << "somebody uses it again";
  const MonoTime left = loop.now();
  opened_again.reset();
  wait_until_none();
  EXPECT_GE(loop.now() - left, 50ms);
  EXPECT_EQ(owner->connections(), 1);
}

TEST_F(MirrorsTest, ResumesAfterItsNewestSample) {
  const std::shared_ptr<Stream> stream = opened(5);
  owner->cut();
  const net::Frame subscribe = serve(6);
  EXPECT_EQ(subscribe.subscribe().from_tid(), 6);
  EXPECT_EQ(subscribe.subscribe().incarnation(), 7u);
  samples(6, 8);
  owner->send_caught_up();
  until_newest(*stream, 8);
  until_state(proto::Mirror::LIVE);
  EXPECT_EQ(state().reconnects(), 1u);
  EXPECT_EQ(state().gap_samples(), 0u);
  EXPECT_EQ(state().error(), "");
}

TEST_F(MirrorsTest, CountsWhatTheOwnerNoLongerHas) {
  const std::shared_ptr<Stream> stream = opened(5);
  owner->cut();
  serve(6);
  owner->send(gap_frame(6, 14));
  samples(20, 22);
  owner->send_sample({23, {}, {}}, Bytes(24), true);
  samples(24, 24);
  until_newest(*stream, 24);
  EXPECT_EQ(state().gap_samples(), 15u);
  EXPECT_TRUE(logger.contains("14 samples"));
  EXPECT_EQ(stream->info().oldest, 24);
}

TEST_F(MirrorsTest, KeepsTheRingWhileTheOwnerIsUnavailable) {
  const std::shared_ptr<Stream> stream = opened(5);
  catalog.host_down(owner->host().greeting.host_id, {Errc::unavailable, "no sign of life"});
  until_state(proto::Mirror::OWNER_UNAVAILABLE);
  EXPECT_NE(state().error().find("no sign of life"), std::string::npos) << state().error();
  const auto answer = open();
  ASSERT_TRUE(answer->has_value()) << "the history is here";
  EXPECT_EQ(newest(*(*answer)->value().stream), 5);
}

TEST_F(MirrorsTest, FollowsTheOwnerToANewAddress) {
  const std::shared_ptr<Stream> stream = opened(5);
  const wire::Greeting greeting = owner->host().greeting;
  catalog.host_down(greeting.host_id, {Errc::unavailable, "gone"});
  owner = std::make_unique<ScriptedHost>(loop);  // another port
  catalog.host_up(owner->host().greeting, owner->address());
  serve(6);
  samples(6, 6);
  until_newest(*stream, 6);
}

// The control connection went over to another network interface; the channel's may seem to work.
TEST_F(MirrorsTest, LosesNothingWhenTheSameOwnerIsReachedAtAnotherAddress) {
  const std::shared_ptr<Stream> stream = opened(5);
  const wire::Greeting greeting = owner->host().greeting;
  const std::unique_ptr<ScriptedHost> before = std::move(owner);
  owner = std::make_unique<ScriptedHost>(loop);
  owner->greet_as(greeting);
  catalog.host_down(greeting.host_id, {Errc::unavailable, "no sign of life"});
  catalog.host_up(greeting, owner->address());
  const net::Frame subscribe = serve(6);
  EXPECT_EQ(subscribe.subscribe().from_tid(), 6);
  EXPECT_EQ(subscribe.subscribe().incarnation(), 7u);
  samples(6, 8);
  owner->send_caught_up();
  until_newest(*stream, 8);
  until_state(proto::Mirror::LIVE);
  EXPECT_EQ(stream->info().oldest, 0);
  EXPECT_EQ(state().gap_samples(), 0u);
  EXPECT_EQ(before->connections(), 1);
}

TEST_F(MirrorsTest, BeginsANewRingWhenTheOwnerLostItsOwn) {
  const std::shared_ptr<Stream> old = opened(5);
  owner->cut();
  theirs.incarnation = 8;
  const net::Frame subscribe = serve(0);
  EXPECT_TRUE(subscribe.subscribe().from_oldest());
  samples(0, 1);
  run_until(loop, [&] { return find() != old; });
  EXPECT_TRUE(replaced.empty()) << "not before there is something to read";
  owner->send_caught_up();
  run_until(loop, [&] { return !replaced.empty(); });
  EXPECT_EQ(replaced, std::vector<const Stream*>{old.get()});
  EXPECT_EQ(newest(*old), 5) << "who holds it keeps it";
  const auto answer = open();
  ASSERT_TRUE(answer->has_value());
  EXPECT_EQ((*answer)->value().stream->incarnation(), 8u);
  EXPECT_EQ(newest(*(*answer)->value().stream), 1);
  EXPECT_EQ(state().restarts(), 1u);
  EXPECT_EQ(state().received_samples(), 8u) << "of both rings";
}

TEST_F(MirrorsTest, KeepsTheRingOfARemovedStreamAndTriesAgain) {
  const std::shared_ptr<Stream> stream = opened(5);
  catalog.stream_added(owner->host().greeting.host_id, theirs).value();
  owner->send(removed_frame());
  until_state(proto::Mirror::REMOVED);
  EXPECT_NE(state().error(), "");
  catalog.stream_removed(owner->host().greeting.host_id, kOdometry);
  theirs.incarnation = 8;
  catalog.stream_added(owner->host().greeting.host_id, theirs).value();
  run_until(loop, [&] { return owner->connections() == 2; });
  serve(0);
  owner->send_caught_up();
  until_state(proto::Mirror::LIVE);
  EXPECT_EQ(replaced.size(), 1u);
}

// The catalog's connection may be quicker than the channel.
TEST_F(MirrorsTest, OpensNoRingOfAStreamThatTheCatalogKnowsToBeRemoved) {
  const wire::HostId host_id = owner->host().greeting.host_id;
  const std::shared_ptr<Stream> stream = opened(5);
  catalog.stream_added(host_id, theirs).value();
  catalog.stream_removed(host_id, kOdometry);
  const auto answer = open();
  EXPECT_FALSE(answer->has_value());
  samples(6, 6);
  owner->send(removed_frame());
  EXPECT_EQ(wait_error(answer).code, Errc::not_found);
  EXPECT_EQ(newest(*stream), 6) << "its readers get the last samples";
}

TEST_F(MirrorsTest, OpensItsRingWhenTheCatalogNoticesTheLastOnesRemovalLate) {
  const wire::HostId host_id = owner->host().greeting.host_id;
  const std::shared_ptr<Stream> stream = opened(5);
  StreamInfo last = theirs;
  last.incarnation = theirs.incarnation - 1;
  catalog.stream_added(host_id, last).value();
  catalog.stream_removed(host_id, kOdometry);
  const auto answer = open();
  ASSERT_TRUE(answer->has_value());
  EXPECT_EQ((*answer)->value().stream, stream);
}

TEST_F(MirrorsTest, OpensItsRingWhenTheOwnerWasDownWithItsStreams) {
  const std::shared_ptr<Stream> stream = opened(5);
  const KnownHost host = owner->host();
  catalog.stream_added(host.greeting.host_id, theirs).value();
  catalog.host_down(host.greeting.host_id, {Errc::unavailable, "it is silent"});
  catalog.host_up(host.greeting, host.address);
  const auto answer = open();
  ASSERT_TRUE(answer->has_value());
  EXPECT_EQ((*answer)->value().stream, stream);
}

TEST_F(MirrorsTest, RequestsARemovedStreamAgainWhenAProgramOpensIt) {
  const std::shared_ptr<Stream> stream = opened(5);
  owner->send(removed_frame());
  until_state(proto::Mirror::REMOVED);
  const auto answer = open();
  EXPECT_FALSE(answer->has_value());
  run_until(loop, [&] { return owner->connections() == 2; });
  owner->fail(owner->receive(), Errc::not_found, "there is no such stream");
  EXPECT_EQ(wait_error(answer).code, Errc::not_found);
  EXPECT_EQ(count(), 1u) << "its reader stays";
  // Nobody has to tell: it looks by itself as well.
  run_until(loop, [&] { return owner->connections() == 3; });
  serve(6);
  owner->send_caught_up();
  until_state(proto::Mirror::LIVE);
}

TEST_F(MirrorsTest, HasItsReadersAskAgainWhenThisHostMayNotReadTheStreamAnyMore) {
  const std::shared_ptr<Stream> stream = opened(5);
  owner->cut();
  run_until(loop, [&] { return owner->connections() == 2; });
  owner->fail(owner->receive(), Errc::no_permission, "host 'pc1' may not read 'odometry:0@pc2'");
  run_until(loop, [&] { return !replaced.empty(); });
  EXPECT_EQ(replaced, std::vector<const Stream*>{stream.get()});
  EXPECT_EQ(state().state(), proto::Mirror::OWNER_UNAVAILABLE);
  EXPECT_EQ(state().error(), "host 'pc1' may not read 'odometry:0@pc2'");
  const auto answer = open();
  EXPECT_FALSE(answer->has_value()) << "only the owner knows";
  run_until(loop, [&] { return owner->connections() == 3; });
  owner->fail(owner->receive(), Errc::no_permission, "no");
  EXPECT_EQ(wait_error(answer).code, Errc::no_permission);
  EXPECT_EQ(replaced.size(), 1u) << "they know, and ask by themselves";
  // It may read it again.
  const auto again = open();
  run_until(loop, [&] { return owner->connections() == 4; });
  serve(6);
  owner->send_caught_up();
  EXPECT_EQ(wait(again), stream);
  EXPECT_EQ(replaced.size(), 1u);
}

TEST_F(MirrorsTest, ContinuesWithARingThatAProgramKept) {
  std::vector<UniqueFd> kept;
  {
    const std::shared_ptr<Stream> stream = opened(5);
    kept = stream->descriptors_for(Role::reader).value();
  }
  streams = std::make_unique<RemoteStreams<Mirror>>(parts, catalog);
  catalog.host_down(owner->host().greeting.host_id, {Errc::unavailable, "not known yet"});
  std::vector<UniqueFd> again;
  for (const UniqueFd& fd : kept) again.push_back(copy_of(fd));
  auto stream = streams->adopt_untrusted(kOdometry, as_offer(std::move(again)));
  ASSERT_TRUE(stream) << stream.error().message;
  EXPECT_EQ(state().state(), proto::Mirror::CONNECTING);
  EXPECT_EQ(state().newest(), 5);
  // The second program that holds it.
  auto second = streams->adopt_untrusted(kOdometry, as_offer(std::move(kept)));
  ASSERT_TRUE(second) << second.error().message;
  EXPECT_EQ(second->get(), stream->get());
  catalog.host_up(owner->host().greeting, owner->address());
  const net::Frame subscribe = serve(6);
  EXPECT_EQ(subscribe.subscribe().from_tid(), 6);
  samples(6, 6);
  until_newest(**stream, 6);
}

TEST_F(MirrorsTest, RefusesRingsThatAreNoMirrors) {
  // Programs can write to these: dssmd must not build on what stands there.
  EXPECT_EQ(offer(Purpose::remote_writer, kOdometry, Role::reader).code, Errc::protocol);
  EXPECT_EQ(offer(Purpose::own, kOdometry, Role::reader).code, Errc::protocol);
  EXPECT_EQ(offer(Purpose::mirror, {"other", 0, "pc2"}, Role::reader).code, Errc::protocol);
  EXPECT_EQ(count(), 0u);
  EXPECT_EQ(registry.budget().used(), 0u);
}

TEST_F(MirrorsTest, RefusesAnOfferedRingWhenTheMirrorHasAnother) {
  const std::shared_ptr<Stream> stream = opened(5);
  auto other = Stream::create({.id = kOdometry,
                               .type = odometry_type(),
                               .depth = 16,
                               .cycle = 1ms,
                               .purpose = Purpose::mirror,
                               .incarnation = 7},
                              registry.budgets())
                   .value();
  EXPECT_EQ(
      streams->adopt_untrusted(kOdometry, as_offer(other->descriptors_for(Role::reader).value()))
          .error()
          .code,
      Errc::conflict);
  EXPECT_EQ(count(), 1u);
}

TEST_F(MirrorsTest, DoesNotReadFromAnotherPcAtTheOwnersAddress) {
  owner->greet_as(greeting_of("pc3"));
  const auto answer = open();
  run_until(loop, [&] { return answer->has_value(); });
  EXPECT_EQ((*answer)->error().code, Errc::unavailable);
  EXPECT_NE((*answer)->error().message.find("pc3"), std::string::npos)
      << (*answer)->error().message;
  EXPECT_FALSE(owner->has_request() && owner->receive().has_open());
}

// Each costs the connection, and nothing else: the mirror tries again.
TEST_F(MirrorsTest, ClosesTheChannelOfAnOwnerThatBreaksTheProtocol) {
  const std::shared_ptr<Stream> stream = opened(5);
  int connections = 1;
  const auto expect_closed = [&](const std::function<void()>& offence) {
    offence();
    run_until(loop, [&] { return owner->connections() > connections; });
    ++connections;
    serve(6);
    owner->send_caught_up();
    until_state(proto::Mirror::LIVE);
    EXPECT_EQ(newest(*stream), 5);
  };
  expect_closed([&] { samples(5, 5); });                                    // a tid twice
  expect_closed([&] { owner->send(gap_frame(0, 3)); });                     // what is here
  expect_closed([&] { owner->send(opened_frame(net::Frame(), theirs)); });  // unasked
  net::Frame another;
  another.set_serial(77);
  expect_closed([&] { owner->send(opened_frame(another, theirs)); });  // to no request
  expect_closed([&] { owner->send_sample({6, {}, {}}, Bytes(25)); });
}

TEST_F(MirrorsTest, IgnoresFramesOfALaterVersion) {
  const std::shared_ptr<Stream> stream = opened(5);
  owner->send(net::Frame());
  samples(6, 6);
  until_newest(*stream, 6);
  EXPECT_EQ(owner->connections(), 1);
}

}  // namespace
}  // namespace dssm::daemon
