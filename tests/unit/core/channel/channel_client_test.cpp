// SPDX-License-Identifier: Apache-2.0
//
// The client end of a channel without a connection: what it asks, which answers it takes, and what
// it makes of the owner's events. And its SampleCursor.
#include "core/channel/channel_client.hpp"

#include <gtest/gtest.h>

#include <deque>

namespace dssm::channel {
namespace {

using namespace std::chrono_literals;

const StreamId kId{"lidar", 2, "pc2"};

struct ChannelClientTest : testing::Test, ChannelClient::Delegate {
  ChannelClient client{*this};
  std::deque<net::Frame> sent;
  std::optional<StreamInfo> opened;
  std::optional<Tid> first;
  int caught_up = 0, others = 0;
  std::vector<std::pair<Tid, std::uint64_t>> gaps;
  std::vector<std::int64_t> published;
  std::optional<std::int64_t> begun_after;
  std::vector<Error> refused, ended;
  StreamInfo theirs;

  ChannelClientTest() {
    theirs.id = kId;
    theirs.type = TypeInfo{"Scan", 8, 8, {}};
    theirs.depth = 16;
    theirs.cycle = 10ms;
    theirs.incarnation = 7;
  }

  void send(const net::Frame& frame) override { sent.push_back(frame); }
  Result<void> on_opened(StreamInfo stream, bool) override {
    opened = std::move(stream);
    return {};
  }
  Result<void> on_subscribed_untrusted(Tid tid, bool, Tid, Tid) override {
    first = tid;
    return {};
  }
  Result<void> on_caught_up() override {
    ++caught_up;
    return {};
  }
  Result<void> on_gap_untrusted(Tid tid, std::uint64_t count) override {
    gaps.emplace_back(tid, count);
    return {};
  }
  Result<void> on_published_untrusted(std::int64_t last, Tid, bool begins) override {
    if (begins) {
      begun_after = last;
    } else {
      published.push_back(last);
    }
    return {};
  }
  Result<void> on_refused(ChannelClient::Request, const Error& why) override {
    refused.push_back(why);
    return {};
  }
  Result<void> on_ended(const Error& why) override {
    ended.push_back(why);
    return {};
  }
  Result<void> on_other_frame(net::Frame&) override {
    ++others;
    return {};
  }

  net::Frame take() {
    net::Frame frame = std::move(sent.front());
    sent.pop_front();
    return frame;
  }
  Result<void> receive(net::Frame frame) { return client.on_frame(frame); }
  net::Frame opened_frame(std::uint64_t serial) {
    net::Frame frame;
    frame.set_serial(serial);
    wire::to_message(theirs, *frame.mutable_opened()->mutable_stream());
    return frame;
  }
  Result<void> answer_open() {
    client.open(kId, nullptr);
    return receive(opened_frame(take().serial()));
  }
  Result<void> answer_subscribe(std::uint64_t incarnation = 7) {
    client.subscribe({});
    net::Frame answer;
    answer.set_serial(take().serial());
    answer.mutable_subscribed()->set_incarnation(incarnation);
    answer.mutable_subscribed()->set_first_tid(5);
    return receive(answer);
  }
  static net::Frame failure(std::uint64_t serial, Errc code) {
    net::Frame frame;
    frame.set_serial(serial);
    wire::to_message(Error{code, "no"}, *frame.mutable_failure());
    return frame;
  }
  static net::Frame gap() {
    net::Frame frame;
    frame.mutable_gap()->set_first_tid(5);
    frame.mutable_gap()->set_count(2);
    return frame;
  }
  static net::Frame caught_up_frame() {
    net::Frame frame;
    frame.mutable_caught_up();
    return frame;
  }
  static net::Frame published_frame(std::int64_t last) {
    net::Frame frame;
    frame.mutable_published()->set_last(last);
    return frame;
  }
};

TEST_F(ChannelClientTest, OpensAndSubscribesAndIsLiveWhenTheHistoryHasCome) {
  client.open(kId, nullptr);
  EXPECT_EQ(client.stream(), ChannelClient::Stream::opening);
  const net::Frame open = take();
  EXPECT_EQ(open.open().id().name(), "lidar");
  EXPECT_EQ(open.open().id().id(), 2);
  ASSERT_TRUE(receive(opened_frame(open.serial())));
  EXPECT_EQ(client.stream(), ChannelClient::Stream::open);
  EXPECT_TRUE(client.is_settled());
  EXPECT_EQ(opened->incarnation, 7u);
  EXPECT_EQ(opened->type, theirs.type);
  ASSERT_TRUE(answer_subscribe());
  EXPECT_EQ(first, 5);
  EXPECT_TRUE(client.takes_samples());
  EXPECT_EQ(client.reading(), ChannelClient::Reading::filling);
  ASSERT_TRUE(receive(gap()));
  EXPECT_EQ(gaps, (std::vector<std::pair<Tid, std::uint64_t>>{{5, 2}}));
  ASSERT_TRUE(receive(caught_up_frame()));
  EXPECT_EQ(client.reading(), ChannelClient::Reading::live);
  EXPECT_EQ(caught_up, 1);
}

TEST_F(ChannelClientTest, CreatesByAPlan) {
  const CreatePlan plan{theirs.type, {32, 5ms}};
  client.open(kId, &plan);
  const proto::Create create = take().create();
  EXPECT_EQ(create.type().name(), "Scan");
  EXPECT_EQ(create.depth(), 32u);
  EXPECT_EQ(create.cycle_ns(), 5'000'000);
}

TEST_F(ChannelClientTest, PublishesFromWhereTheOwnerStopped) {
  ASSERT_TRUE(answer_open());
  client.publish(99);
  EXPECT_FALSE(client.is_settled());
  const net::Frame start = take();
  EXPECT_EQ(start.start_publishing().publisher(), 99u);
  net::Frame answer;
  answer.set_serial(start.serial());
  answer.mutable_publishing()->set_last(3);
  ASSERT_TRUE(receive(answer));
  EXPECT_EQ(begun_after, 3);
  EXPECT_EQ(client.writing(), ChannelClient::Writing::granted);
  ASSERT_TRUE(receive(published_frame(4)));
  EXPECT_EQ(published, std::vector<std::int64_t>{4});
}

TEST_F(ChannelClientTest, ForwardsTheOwnersRefusal) {
  client.open(kId, nullptr);
  ASSERT_TRUE(receive(failure(take().serial(), Errc::type_mismatch)));
  ASSERT_EQ(refused.size(), 1u);
  EXPECT_EQ(refused.front().code, Errc::type_mismatch);
  EXPECT_EQ(client.stream(), ChannelClient::Stream::closed);
  ASSERT_TRUE(answer_open()) << "another try on the same connection";
  client.subscribe({});
  ASSERT_TRUE(receive(failure(take().serial(), Errc::no_permission)));
  client.publish(1);
  ASSERT_TRUE(receive(failure(take().serial(), Errc::no_permission)));
  EXPECT_EQ(refused.size(), 3u);
  EXPECT_TRUE(client.is_settled());
}

TEST_F(ChannelClientTest, ReportsThatTheStreamWasRemoved) {
  ASSERT_TRUE(answer_open());
  net::Frame frame;
  frame.mutable_ended()->set_removed(true);
  ASSERT_TRUE(receive(frame));
  ASSERT_EQ(ended.size(), 1u);
  EXPECT_EQ(ended.front().code, Errc::not_found);
  EXPECT_NE(ended.front().message.find("lidar:2@pc2"), std::string::npos);
}

TEST_F(ChannelClientTest, PassesOnAnswersToItsDelegatesRequestsAndWhatItDoesNotKnow) {
  ASSERT_TRUE(answer_open());
  net::Frame answer;
  answer.set_serial(client.next_serial());
  answer.mutable_range();
  ASSERT_TRUE(receive(answer));
  ASSERT_TRUE(receive(net::Frame()));
  EXPECT_EQ(others, 2);
}

TEST_F(ChannelClientTest, RefusesWhatCannotComeNow) {
  EXPECT_FALSE(receive(opened_frame(0)));
  EXPECT_FALSE(receive(gap()));
  EXPECT_FALSE(receive(caught_up_frame()));
  EXPECT_FALSE(receive(published_frame(0)));
  EXPECT_EQ(receive(failure(0, Errc::limit_exceeded)).error().code, Errc::limit_exceeded);
  client.open(kId, nullptr);
  net::Frame done;
  done.set_serial(take().serial());
  done.mutable_done();
  EXPECT_EQ(receive(done).error().code, Errc::protocol);
  EXPECT_TRUE(gaps.empty() && published.empty() && !opened && caught_up == 0);
}

TEST_F(ChannelClientTest, RefusesAnInvalidDescription) {
  const StreamInfo good = theirs;
  const auto expect_refused = [&](const std::function<void()>& spoil) {
    theirs = good;
    spoil();
    const Result<void> answered = answer_open();
    ASSERT_FALSE(answered);
    EXPECT_EQ(answered.error().code, Errc::protocol) << answered.error().message;
    EXPECT_FALSE(opened);
  };
  expect_refused([&] { theirs.id.name = "odometry"; });
  expect_refused([&] { theirs.id.id = 3; });
  expect_refused([&] { theirs.id.host = "pc3"; });
  expect_refused([&] { theirs.id.name = ""; });
  expect_refused([&] { theirs.type.payload_bytes = 0; });
  expect_refused([&] { theirs.depth = 1; });
  expect_refused([&] { theirs.depth = kMaxDepth + 1; });
  expect_refused([&] { theirs.cycle = 0ns; });
  expect_refused([&] { theirs.incarnation = 0; });
  expect_refused([&] { theirs.newest = kMaxTid + 1; });
  expect_refused([&] { theirs.newest = -2; });
}

TEST_F(ChannelClientTest, ReconnectsWhenTheRingWasReplacedBetweenOpenAndSubscribe) {
  ASSERT_TRUE(answer_open());
  const Result<void> subscribed = answer_subscribe(8);
  ASSERT_FALSE(subscribed);
  EXPECT_EQ(subscribed.error().code, Errc::unavailable);
  EXPECT_FALSE(client.takes_samples());
}

TEST_F(ChannelClientTest, IgnoresTheEventsOfASubscriptionThatIsBeingReplaced) {
  ASSERT_TRUE(answer_open());
  ASSERT_TRUE(answer_subscribe());
  client.subscribe({});
  EXPECT_TRUE(client.takes_samples()) << "its last samples may still come";
  ASSERT_TRUE(receive(gap()));
  ASSERT_TRUE(receive(caught_up_frame()));
  EXPECT_TRUE(gaps.empty());
  EXPECT_EQ(caught_up, 0);
}

TEST_F(ChannelClientTest, KeepsASubscriptionWhenTheNextOneIsRefused) {
  ASSERT_TRUE(answer_open());
  ASSERT_TRUE(answer_subscribe());
  client.subscribe({});
  client.subscribe({});
  sent.pop_front();
  ASSERT_TRUE(receive(failure(take().serial(), Errc::invalid_argument)));
  EXPECT_EQ(client.reading(), ChannelClient::Reading::filling);
  ASSERT_TRUE(receive(gap()));
  EXPECT_EQ(gaps.size(), 1u);
}

TEST_F(ChannelClientTest, StartsOverOnANewConnection) {
  ASSERT_TRUE(answer_open());
  ASSERT_TRUE(answer_subscribe());
  client.reset();
  EXPECT_EQ(client.stream(), ChannelClient::Stream::closed);
  EXPECT_FALSE(client.takes_samples());
  ASSERT_TRUE(answer_open());
}

// --- SampleCursor

net::Subscribe resumed(const SampleCursor& cursor) {
  net::Subscribe request;
  cursor.resume(7, request);
  return request;
}

TEST(SampleCursor, ResumesWithTheNextSampleOrFromTheOldest) {
  SampleCursor cursor;
  EXPECT_TRUE(resumed(cursor).from_oldest());
  ASSERT_TRUE(cursor.on_subscribed_untrusted(10));
  cursor.on_sample(10);
  EXPECT_EQ(resumed(cursor).from_tid(), 11);
  EXPECT_EQ(resumed(cursor).incarnation(), 7u);
  cursor.set_next(kNoTid);  // another ring
  EXPECT_TRUE(resumed(cursor).from_oldest());
  ASSERT_TRUE(cursor.on_subscribed_untrusted(0));
  EXPECT_EQ(cursor.lost(), 0u);
}

TEST(SampleCursor, CountsEachLostSampleOnce) {
  SampleCursor cursor;
  ASSERT_TRUE(cursor.on_subscribed_untrusted(10));
  ASSERT_TRUE(cursor.on_gap_untrusted(10, 4));
  cursor.on_sample(14);
  EXPECT_EQ(cursor.lost(), 4u);
  cursor.on_sample(17);
  EXPECT_EQ(cursor.lost(), 6u) << "15 and 16 were not reported";
  ASSERT_TRUE(cursor.on_gap_untrusted(16, 4)) << "reported from before the next one";
  EXPECT_EQ(cursor.lost(), 8u);
  ASSERT_TRUE(cursor.on_subscribed_untrusted(23));
  EXPECT_EQ(cursor.lost(), 11u) << "the owner resumes later";
  EXPECT_EQ(cursor.next(), 23);
}

TEST(SampleCursor, CountsNothingThatIsLeftOutForTheRate) {
  SampleCursor cursor;
  cursor.set_thinned(true);
  ASSERT_TRUE(cursor.on_subscribed_untrusted(0));
  cursor.on_sample(50);
  ASSERT_TRUE(cursor.on_gap_untrusted(60, 5));
  ASSERT_TRUE(cursor.on_subscribed_untrusted(200));
  EXPECT_EQ(cursor.lost(), 5u);
}

TEST(SampleCursor, RefusesWhatHasComeAndWhatIsNoTid) {
  SampleCursor cursor;
  EXPECT_FALSE(cursor.on_subscribed_untrusted(-1));
  EXPECT_FALSE(cursor.on_subscribed_untrusted(kMaxTid + 1));
  ASSERT_TRUE(cursor.on_subscribed_untrusted(10));
  EXPECT_FALSE(cursor.on_subscribed_untrusted(9));
  EXPECT_FALSE(cursor.accepts(9));
  EXPECT_TRUE(cursor.accepts(10));
  EXPECT_FALSE(cursor.accepts(kMaxTid + 1));
  EXPECT_FALSE(cursor.on_gap_untrusted(7, 3)) << "all of them have come";
  EXPECT_FALSE(cursor.on_gap_untrusted(-1, 20));
  EXPECT_FALSE(cursor.on_gap_untrusted(10, ~std::uint64_t{0}));
  EXPECT_EQ(cursor.lost(), 0u);
  EXPECT_EQ(cursor.next(), 10);
}

}  // namespace
}  // namespace dssm::channel
