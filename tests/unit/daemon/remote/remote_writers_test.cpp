// SPDX-License-Identifier: Apache-2.0
//
// Remote writers against an owner that does what the test says.
#include <gtest/gtest.h>

#include <new>

#include "core/ring/ring_writer.hpp"
#include "daemon/remote/remote_writer.hpp"
#include "tests/unit/daemon/remote/remote_stream_test.hpp"

namespace dssm::daemon {
namespace {

using namespace std::chrono_literals;

// A program that has the ring open for writing.
class Program {
 public:
  explicit Program(Stream& stream) : fds_(stream.descriptors_for(Role::writer).value()) {
    mapping_ = ring::RingMapping::open_untrusted(fds_[0].get(), ring::Access::read_write).value();
    bell_ = ring::Bell::open_untrusted(fds_[1].get()).value();
  }
  // Sample i has the time i and bytes of i. Returns its tid.
  Tid write(int i) {
    ring::RingWriter writer(*mapping_, *bell_, fds_[3].get());
    return writer.write(Bytes(24, static_cast<std::byte>(i)), time_from_ns(i), Duration(1));
  }
  OfferedFiles offer() const {
    std::vector<UniqueFd> copies;
    for (const UniqueFd& fd : fds_) copies.push_back(copy_of(fd));
    return as_offer(std::move(copies));
  }

 private:
  std::vector<UniqueFd> fds_;
  std::shared_ptr<const ring::RingMapping> mapping_;
  std::shared_ptr<ring::Bell> bell_;
};

class RemoteWritersTest : public RemoteStreamTest<RemoteWriter> {
 protected:
  CreatePlan plan{odometry_type(), kHistory};

  // Answers Open or Create, and StartPublishing. Returns the publisher's number.
  std::uint64_t serve(Tid last, bool created = false) {
    net::Frame opened = opened_frame(owner->receive(), theirs);
    opened.mutable_opened()->set_created(created);
    owner->send(opened);
    const net::Frame start = owner->receive();
    EXPECT_TRUE(start.has_start_publishing());
    publishing(start, last);
    return start.start_publishing().publisher();
  }
  void publishing(const net::Frame& start, Tid last) {
    owner->take_samples(24);
    net::Frame answer = answer_to(start);
    answer.mutable_publishing()->set_last(last);
    owner->send(answer);
  }
  void acknowledge(Tid last) {
    net::Frame frame;
    frame.mutable_published()->set_last(last);
    owner->send(frame);
  }
  std::shared_ptr<Stream> opened() {
    const auto answer = open(&plan);
    serve(-1, true);
    return wait(answer).stream;
  }
  // Sample i is the one that Program::write(i) wrote.
  void until_published(int i) {
    run_until(loop, [&] {
      return !owner->published.empty() && owner->published.back().info.time == time_from_ns(i) &&
             owner->published.back().complete;
    });
  }
  std::vector<int> times() {
    std::vector<int> times;
    for (const ScriptedHost::Published& one : owner->published) {
      times.push_back(static_cast<int>(to_ns(one.info.time)));
      EXPECT_EQ(one.payload, Bytes(24, static_cast<std::byte>(times.back())));
    }
    return times;
  }
};

// One program waits whose first answer finds no memory, and then another one.
class RemoteWritersWithoutMemory : public RemoteWritersTest {
 protected:
  void open_both() {
    streams->open(owner->host(), kOdometry, &plan, [this](const Result<OpenedRing>& result) {
      if (++calls == 1) throw std::bad_alloc();
      ASSERT_FALSE(result);
      failed_with = result.error().code;
    });
    other = open(&plan);
  }
  int calls = 0;
  std::optional<Errc> failed_with;
  std::shared_ptr<Answer> other;
};

TEST_F(RemoteWritersWithoutMemory, AnswerOthersWhenTheOwnerAnswers) {
  open_both();
  serve(-1, true);
  EXPECT_TRUE(wait(other).stream);
  EXPECT_EQ(failed_with, Errc::no_memory);
}

TEST_F(RemoteWritersWithoutMemory, AnswerOthersWhenTheOwnerDoesNot) {
  open_both();
  EXPECT_EQ(wait_error(other).code, Errc::unavailable);
  EXPECT_EQ(failed_with, Errc::no_memory);
}

TEST_F(RemoteWritersTest, CreatesTheStreamAtItsOwnerAndPublishes) {
  const auto answer = open(&plan);
  const net::Frame create = owner->receive();
  ASSERT_TRUE(create.has_create());
  EXPECT_EQ(create.create().id().name(), "odometry");
  EXPECT_EQ(create.create().depth(), kHistory.depth);
  EXPECT_EQ(create.create().cycle_ns(), to_ns(kHistory.cycle));
  EXPECT_EQ(create.create().type().name(), "Odometry");
  owner->send(opened_frame(create, theirs));
  publishing(owner->receive(), -1);
  const OpenedRing writer = wait(answer);
  EXPECT_FALSE(writer.created);
  EXPECT_EQ(writer.stream->id(), kOdometry);
  EXPECT_EQ(writer.stream->type(), odometry_type());
  EXPECT_EQ(writer.stream->purpose(), Purpose::remote_writer);
  Program program(*writer.stream);
  for (int i = 0; i < 5; ++i) EXPECT_EQ(program.write(i), i);
  until_published(4);
  EXPECT_EQ(times(), (std::vector<int>{0, 1, 2, 3, 4}));
  for (int i = 0; i < 5; ++i) {
    EXPECT_EQ(owner->published[static_cast<std::size_t>(i)].info.tid, i);
    EXPECT_EQ(owner->published[static_cast<std::size_t>(i)].info.clock_error, Duration(1));
    EXPECT_EQ(owner->published[static_cast<std::size_t>(i)].serial, 0u);
  }
}

TEST_F(RemoteWritersTest, ReportsWhichRequestCreatedTheStream) {
  const auto first = open(&plan), second = open(&plan);
  serve(-1, true);
  EXPECT_TRUE(wait(first).created);
  EXPECT_FALSE(wait(second).created);
  EXPECT_EQ(wait(first).stream, wait(second).stream);
  EXPECT_EQ(owner->connections(), 1);
}

// Then write() returns the tid that the sample gets over there.
TEST_F(RemoteWritersTest, ContinuesTheTidsOfTheOwnersRing) {
  theirs.newest = 99;
  Program program(*opened());
  EXPECT_EQ(program.write(0), 100);
  EXPECT_EQ(program.write(1), 101);
  until_published(1);
  EXPECT_EQ(owner->published.front().info.tid, 100);
  EXPECT_EQ(times(), (std::vector<int>{0, 1}));
}

TEST_F(RemoteWritersTest, OpensAnExistingStreamWithoutCreatingIt) {
  const auto answer = open();
  const net::Frame request = owner->receive();
  EXPECT_TRUE(request.has_open());
  owner->fail(request, Errc::not_found, "there is no stream 'odometry:0@pc2'");
  EXPECT_EQ(wait_error(answer).code, Errc::not_found);
  wait_until_none();
  EXPECT_EQ(registry.budget().used(), 0u);
}

// One is refused, the other not.
TEST_F(RemoteWritersTest, SendsTheRequestOfEachProgramThatWaits) {
  const auto opening = open(), creating = open(&plan);
  owner->fail(owner->receive(), Errc::not_found, "there is no stream 'odometry:0@pc2'");
  EXPECT_EQ(wait_error(opening).code, Errc::not_found);
  EXPECT_FALSE(creating->has_value());
  serve(-1, true);
  EXPECT_TRUE(wait(creating).created);
}

TEST_F(RemoteWritersTest, ForwardsThatTheTypeDiffers) {
  const auto answer = open(&plan);
  owner->fail(owner->receive(), Errc::type_mismatch, "it has 8 bytes");
  EXPECT_EQ(wait_error(answer).code, Errc::type_mismatch);
}

TEST_F(RemoteWritersTest, ChecksTheTypeOfThoseWhoJoin) {
  const std::shared_ptr<Stream> stream = opened();
  const CreatePlan other{{"Other", 24, 8, {}}, kHistory};
  const auto answer = open(&other);
  ASSERT_TRUE(answer->has_value());
  EXPECT_EQ((*answer)->error().code, Errc::type_mismatch);
  EXPECT_TRUE(open(&plan)->has_value());
}

TEST_F(RemoteWritersTest, NeverCreatesTheStreamForAProgramThatMayOnlyJoinIt) {
  plan.scope = CreatePlan::Scope::join;
  const auto answer = open(&plan);
  const net::Frame request = owner->receive();
  EXPECT_TRUE(request.has_open());
  owner->send(opened_frame(request, theirs));
  publishing(owner->receive(), -1);
  const OpenedRing writer = wait(answer);
  owner->cut();
  EXPECT_TRUE(owner->receive().has_open()) << "nor after a cut";
}

TEST_F(RemoteWritersTest, ChecksItselfWhatTheOwnerMayNotReplace) {
  using Scope = CreatePlan::Scope;
  CreatePlan deeper = plan, other = plan, keeping = plan;
  deeper.history.depth = theirs.depth + 1;
  other.type = {"Other", 24, 8, {}};
  keeping.history.depth = deeper.history.depth;
  keeping.keep_existing = true;
  for (const Scope scope : {Scope::join, Scope::create}) {
    deeper.scope = other.scope = keeping.scope = scope;
    const auto too_short = open(&deeper), of_other_type = open(&other), fits = open(&keeping);
    const net::Frame request = owner->receive();
    EXPECT_EQ(request.has_open(), scope == Scope::join);
    EXPECT_EQ(request.create().keep_existing(), scope == Scope::create);
    owner->send(opened_frame(request, theirs));
    publishing(owner->receive(), -1);
    EXPECT_EQ(wait_error(too_short).code, Errc::conflict);
    EXPECT_EQ(wait_error(of_other_type).code, Errc::type_mismatch);
    static_cast<void>(wait(fits));
    fits->reset();
    wait_until_none();
  }
}

TEST_F(RemoteWritersTest, FailsWithAReasonWhenTheOwnerDoesNotAnswer) {
  const KnownHost host = owner->host();
  owner.reset();
  const Error error = wait_error(open_at(host, &plan));
  EXPECT_EQ(error.code, Errc::unavailable);
  EXPECT_NE(error.message.find("odometry:0@pc2"), std::string::npos) << error.message;
  wait_until_none();
}

TEST_F(RemoteWritersTest, CatchesUpFromWhereTheOwnerStopped) {
  const std::shared_ptr<Stream> stream = opened();
  Program program(*stream);
  for (int i = 0; i < 3; ++i) program.write(i);
  until_published(2);
  acknowledge(0);
  owner->published.clear();
  owner->cut();
  for (int i = 3; i < 6; ++i) EXPECT_EQ(program.write(i), i) << "it goes on without the link";
  EXPECT_EQ(serve(1), stream->incarnation()) << "the same publisher";
  until_published(5);
  EXPECT_EQ(times(), (std::vector<int>{2, 3, 4, 5})) << "1 was written though not acknowledged";
}

// Its ring is another one, or 64 others have published since. Also while it is connected: when the
// first sample comes torn, for example, it has none to acknowledge.
TEST_F(RemoteWritersTest, ContinuesAfterTheAcknowledgedSampleWhenTheOwnerHasForgottenIt) {
  const std::shared_ptr<Stream> stream = opened();
  const auto expect_known = [&](Tid last) {
    run_until(loop, [&] { return stream->mapping().header().first.load() == last + 1; });
  };
  Program program(*stream);
  for (int i = 0; i < 4; ++i) program.write(i);
  until_published(3);
  acknowledge(1);
  expect_known(1);
  owner->published.clear();
  owner->cut();
  serve(kNoTid);
  until_published(3);
  acknowledge(kNoTid);
  acknowledge(2);
  expect_known(2);
  owner->cut();
  serve(0);
  acknowledge(1);
  program.write(4);
  until_published(4);
  EXPECT_EQ(times(), (std::vector<int>{2, 3, 3, 4}));
  EXPECT_EQ(owner->connections(), 3);
}

TEST_F(RemoteWritersTest, ContinuesInANewRingOfTheOwner) {
  Program program(*opened());
  for (int i = 0; i < 3; ++i) program.write(i);
  until_published(2);
  acknowledge(1);
  owner->published.clear();
  owner->cut();
  theirs.incarnation = 8;  // came back without its ring
  EXPECT_TRUE(owner->receive().has_create()) << "so it is created again";
}

TEST_F(RemoteWritersTest, PublishesIntoANewRingWhatWasNotPublished) {
  const std::shared_ptr<Stream> stream = opened();
  Program program(*stream);
  for (int i = 0; i < 3; ++i) program.write(i);
  until_published(2);
  acknowledge(1);
  run_until(loop, [&] { return stream->mapping().header().first.load() == 2; });
  owner->published.clear();
  owner->cut();
  theirs.incarnation = 8;
  serve(-1, true);
  until_published(2);
  EXPECT_EQ(times(), (std::vector<int>{2}));
}

TEST_F(RemoteWritersTest, CountsWhatItsRingNoLongerHolds) {
  const std::shared_ptr<Stream> stream = opened();
  Program program(*stream);
  program.write(0);
  until_published(0);
  owner->cut();
  owner->published.clear();
  const Tid depth = static_cast<Tid>(stream->info().depth);
  EXPECT_EQ(depth, static_cast<Tid>(OutgoingRing::kMinSlots));
  for (int i = 1; i <= depth + 9; ++i) program.write(i);
  serve(0);
  until_published(static_cast<int>(depth) + 9);
  EXPECT_EQ(owner->published.front().info.tid, 11);
  EXPECT_EQ(owner->published.size(), static_cast<std::size_t>(depth - 1));
  EXPECT_TRUE(logger.contains("lacks 10 samples"));
}

TEST_F(RemoteWritersTest, EndsWhenItsProgramsHaveGoneAndAllIsPublished) {
  std::shared_ptr<Stream> stream = opened();
  std::optional<Program> program(std::in_place, *stream);
  program->write(0);
  program.reset();
  stream.reset();
  until_published(0);
  event_base_loop(loop.base(), EVLOOP_ONCE | EVLOOP_NONBLOCK);
  EXPECT_EQ(count(), 1u) << "not known to be written";
  acknowledge(0);
  run_until(loop, [&] { return count() == 0 && !owner->connected(); });
  EXPECT_EQ(registry.budget().used(), 0u);
  EXPECT_TRUE(logger.warnings.empty());
}

TEST_F(RemoteWritersTest, EndsAtOnceWhenNothingIsLeftToPublish) {
  opened().reset();
  wait_until_none();
}

TEST_F(RemoteWritersTest, IsJoinedWhileItDrains) {
  std::shared_ptr<Stream> stream = opened();
  Program program(*stream);
  program.write(0);
  until_published(0);
  stream.reset();
  stream = wait(open(&plan)).stream;
  acknowledge(0);
  program.write(1);
  until_published(1);
  EXPECT_EQ(owner->connections(), 1);
}

TEST_F(RemoteWritersTest, LeavesARemovedStreamAloneUntilItIsCreatedAgain) {
  const std::shared_ptr<Stream> stream = opened();
  Program program(*stream);
  owner->send(removed_frame());
  run_until(loop, [&] { return owner->connections() == 2; });  // it looks by itself
  const net::Frame look = owner->receive();
  EXPECT_TRUE(look.has_open()) << "but does not create it";
  owner->fail(look, Errc::not_found, "there is no stream");
  program.write(0);
  const auto answer = open(&plan);  // somebody does
  run_until(loop, [&] { return owner->connections() == 3; });
  theirs.incarnation = 8;
  serve(-1, true);
  EXPECT_TRUE(wait(answer).created);
  until_published(0);
  EXPECT_EQ(times(), (std::vector<int>{0}));
}

TEST_F(RemoteWritersTest, ContinuesWithARingThatAProgramKept) {
  std::optional<Program> program;
  std::uint64_t publisher = 0;
  {
    const std::shared_ptr<Stream> stream = opened();
    program.emplace(*stream);
    publisher = stream->incarnation();
    for (int i = 0; i < 3; ++i) program->write(i);
    until_published(2);
    acknowledge(1);
    run_until(loop, [&] { return stream->mapping().header().first.load() == 2; });
    owner->published.clear();
    streams.reset();  // dies
  }
  program->write(3);
  catalog.host_down(owner->host().greeting.host_id, {Errc::unavailable, "not known yet"});
  streams = std::make_unique<RemoteStreams<RemoteWriter>>(parts, catalog);
  const auto stream = streams->adopt_untrusted(kOdometry, program->offer());
  ASSERT_TRUE(stream) << stream.error().message;
  const auto again = streams->adopt_untrusted(kOdometry, program->offer());
  ASSERT_TRUE(again) << again.error().message;
  EXPECT_EQ(stream->get(), again->get());
  catalog.host_up(owner->host().greeting, owner->address());
  // Sample 2 was written, and the word of it was lost with both.
  EXPECT_EQ(serve(2), publisher);
  until_published(3);
  EXPECT_EQ(times(), (std::vector<int>{3}));
  program->write(4);  // with the doorbell that it kept
  until_published(4);
}

TEST_F(RemoteWritersTest, CreatesTheStreamOfAKeptRingOnlyForAProgramThatMayCreateIt) {
  std::optional<Program> program;
  {
    const std::shared_ptr<Stream> stream = opened();
    program.emplace(*stream);
    streams.reset();
  }
  const auto offer = [&](bool may_create) {
    OfferedFiles files = program->offer();
    files.may_create = may_create;
    auto stream = streams->adopt_untrusted(kOdometry, std::move(files));
    EXPECT_TRUE(stream) << stream.error().message;
    return *stream;
  };
  streams = std::make_unique<RemoteStreams<RemoteWriter>>(parts, catalog);
  const std::shared_ptr<Stream> joined = offer(false);
  EXPECT_TRUE(owner->receive().has_open());
  EXPECT_EQ(offer(true), joined);
  owner->cut();
  EXPECT_TRUE(owner->receive().has_create());
}

// The right to create it ends with the last program that had it.
TEST_F(RemoteWritersTest, CreatesTheStreamOnlyWhileAProgramThatMayCreateItHasIt) {
  OpenTable opens{{8, 8}};
  parts.opens = &opens;
  const std::shared_ptr<Stream> ring = opened();
  const OpenNumber creator = opens.add({client(1), ring, Role::writer, 0, false, true});
  opens.add({client(2), ring, Role::writer, 0});
  owner->cut();
  EXPECT_TRUE(owner->receive().has_create());
  EXPECT_TRUE(opens.remove(1, creator));
  owner->cut();
  EXPECT_TRUE(owner->receive().has_open());
}

// Somebody opened the stream before the program came back: no sample of either may get lost.
TEST_F(RemoteWritersTest, PublishesAKeptRingBesideOneThatWasOpenedSince) {
  std::optional<Program> program;
  {
    const std::shared_ptr<Stream> stream = opened();
    program.emplace(*stream);
    streams.reset();
  }
  streams = std::make_unique<RemoteStreams<RemoteWriter>>(parts, catalog);
  const std::shared_ptr<Stream> since = opened();
  const int before = owner->connections();
  const auto kept = streams->adopt_untrusted(kOdometry, program->offer());
  ASSERT_TRUE(kept) << kept.error().message;
  EXPECT_NE(kept->get(), since.get());
  EXPECT_EQ(streams->adopt_untrusted(kOdometry, program->offer()).value(), *kept);
  EXPECT_EQ(count(), 2u);
  run_until(loop, [&] { return owner->connections() > before; });
  program->write(7);
  EXPECT_EQ(serve(-1), (*kept)->incarnation()) << "as a publisher of its own";
  until_published(7);
  EXPECT_EQ(wait(open(&plan)).stream, since) << "the one that is opened stays the same";
}

TEST_F(RemoteWritersTest, RefusesRingsThatAreNoRemoteWriters) {
  EXPECT_EQ(offer(Purpose::mirror, kOdometry, Role::writer).code, Errc::protocol);
  EXPECT_EQ(offer(Purpose::own, kOdometry, Role::writer).code, Errc::protocol);
  EXPECT_EQ(offer(Purpose::remote_writer, {"other", 0, "pc2"}, Role::writer).code, Errc::protocol);
  EXPECT_EQ(count(), 0u);
}

// Each costs the connection, and nothing else.
TEST_F(RemoteWritersTest, ClosesTheChannelOfAnOwnerThatBreaksTheProtocol) {
  const std::shared_ptr<Stream> stream = opened();
  Program program(*stream);
  program.write(0);
  until_published(0);
  int connections = 1;
  const auto expect_closed = [&](const std::function<void()>& offence) {
    offence();
    run_until(loop, [&] { return owner->connections() > connections; });
    ++connections;
    serve(0);
  };
  expect_closed([&] { acknowledge(5); });                              // never sent
  expect_closed([&] { acknowledge(INT64_MAX); });                      // nor that
  expect_closed([&] { owner->send_sample({0, {}, {}}, Bytes(24)); });  // unasked
  program.write(1);
  until_published(1);
}

TEST_F(RemoteWritersTest, RefusesNonsenseInARingThatProgramsWriteTo) {
  const std::shared_ptr<Stream> stream = opened();
  Program program(*stream);
  program.write(0);
  until_published(0);
  const auto mapping = stream->map_for_writing().value();
  for (const Tid nonsense : {Tid{INT64_MAX}, Tid{INT64_MIN}, channel::kMaxTid + 1}) {
    mapping->header().first.store(nonsense);
    owner->cut();
    serve(0);
  }
  mapping->header().first.store(1);
  mapping->header().top.store(INT64_MAX);
  owner->cut();
  const int before = owner->connections();
  run_until(loop, [&] { return owner->connections() > before; });
  mapping->header().top.store(0);
  owner->cut();
  serve(0);
  program.write(1);
  until_published(1);
}

}  // namespace
}  // namespace dssm::daemon
