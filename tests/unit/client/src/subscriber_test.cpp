// SPDX-License-Identifier: Apache-2.0
//
// The subscriber of a channel without a network: what it asks for, in which order it delivers
// samples, what it counts as lost, and how it resumes after a cut and on a new ring.
#include "client/src/subscriber.hpp"

#include <gtest/gtest.h>

#include <array>
#include <cstring>

namespace dssm::detail {
namespace {

using Payload = std::array<std::byte, 8>;

struct SubscriberTest : testing::Test {
  Subscriber subscriber{8};
  Payload target{};
  SampleInfo info;

  void begin(Subscription what = {}) {
    subscriber.begin(what);
    subscribed(what.start == Subscription::Start::tid ? what.tid : 0);
  }
  void subscribed(Tid first) { ASSERT_TRUE(subscriber.on_subscribed_untrusted(first)); }
  void gap(Tid first, std::uint64_t count) {
    ASSERT_TRUE(subscriber.on_gap_untrusted(first, count));
  }
  // Some samples are shorter than the stream's.
  static std::size_t bytes_of(Tid tid) { return tid % 3 == 1 ? 1 : sizeof tid; }
  // What became of it: true: it went somewhere.
  bool arrive(Tid tid, bool torn = false) {
    std::byte* out = nullptr;
    const SampleInfo stamps{tid, time_from_ns(tid), Duration(1), bytes_of(tid)};
    const auto place = subscriber.on_sample_begin(stamps, out);
    EXPECT_TRUE(place);
    if (!*place) return false;
    if (out) std::memcpy(out, &tid, bytes_of(tid));
    subscriber.on_sample_end(stamps, torn);
    return true;
  }
  void expect_kept(Tid tid) {
    ASSERT_TRUE(subscriber.has_buffered());
    ASSERT_EQ(subscriber.pop_buffered(target, info), ReadStatus::ok);
    EXPECT_EQ(info.tid, tid);
    EXPECT_EQ(info.payload_bytes, bytes_of(tid));
    EXPECT_EQ(std::memcmp(target.data(), &tid, bytes_of(tid)), 0);
  }
  net::Subscribe request(std::uint64_t incarnation = 77) {
    net::Subscribe message;
    subscriber.to_message(incarnation, message);
    return message;
  }
};

TEST_F(SubscriberTest, RequestsWhatTheUserRequested) {
  subscriber.begin({});
  EXPECT_TRUE(request().from_now());
  subscriber.begin({.start = Subscription::Start::oldest, .max_rate_hz = 12.5});
  EXPECT_TRUE(request().from_oldest());
  EXPECT_EQ(request().max_rate_hz(), 12.5);
  subscriber.begin({.start = Subscription::Start::tid, .tid = 9});
  EXPECT_EQ(request().from_tid(), 9);
  EXPECT_EQ(request().incarnation(), 77u);
  subscriber.begin({.start = Subscription::Start::time, .time = time_from_ns(-5)});
  EXPECT_EQ(request().from_time_ns(), -5);
}

TEST_F(SubscriberTest, ASampleWithoutAReaderWaits) {
  begin();
  EXPECT_FALSE(arrive(0));
  subscriber.set_target(target.data());
  EXPECT_TRUE(arrive(0));
  ASSERT_TRUE(subscriber.delivered(info));
  EXPECT_EQ(info.tid, 0);
  EXPECT_FALSE(subscriber.delivered(info));
  EXPECT_FALSE(arrive(1)) << "the target is taken";
}

TEST_F(SubscriberTest, KeepsSamplesInOrderAndGivesThemBeforeNewOnes) {
  begin();
  subscriber.set_buffering(true);
  EXPECT_TRUE(arrive(0));
  EXPECT_TRUE(arrive(1));
  subscriber.set_buffering(false);
  subscriber.set_target(target.data());
  EXPECT_FALSE(arrive(2));
  expect_kept(0);
  expect_kept(1);
  EXPECT_TRUE(arrive(2));
  EXPECT_TRUE(subscriber.delivered(info));
}

TEST_F(SubscriberTest, ResumesAtTheSampleThatIsDueAndCountsWhatTheRingLost) {
  begin({.start = Subscription::Start::tid, .tid = 10});
  subscriber.set_buffering(true);
  arrive(10);
  arrive(11);
  subscriber.on_down();
  EXPECT_EQ(request().from_tid(), 12);
  EXPECT_EQ(request().incarnation(), 77u);
  EXPECT_TRUE(arrive(5)) << "what came before the answer is not ours";
  subscribed(15);
  EXPECT_EQ(subscriber.lost(), 3u);
  arrive(15);
  expect_kept(10);
  expect_kept(11);
  expect_kept(15);
  EXPECT_FALSE(subscriber.has_buffered());
}

TEST_F(SubscriberTest, ResumesEvenWhenNothingHadCome) {
  subscriber.begin({});
  subscribed(40);
  subscriber.on_down();
  EXPECT_EQ(request().from_tid(), 40);
}

TEST_F(SubscriberTest, CountsEachLostSampleOnceByGapOrByTid) {
  begin();
  subscriber.set_buffering(true);
  arrive(0);
  gap(1, 4);
  EXPECT_EQ(subscriber.lost(), 4u);
  arrive(5);
  EXPECT_EQ(subscriber.lost(), 4u);
  arrive(8);
  EXPECT_EQ(subscriber.lost(), 6u) << "tids that never came are lost, whoever says so";
  arrive(9, true);
  EXPECT_EQ(subscriber.lost(), 6u);
  gap(9, 1);
  EXPECT_EQ(subscriber.lost(), 7u);
  arrive(10);
  EXPECT_EQ(subscriber.lost(), 7u);
  EXPECT_FALSE(subscriber.on_gap_untrusted(3, 2)) << "of long ago";
  EXPECT_FALSE(subscriber.on_gap_untrusted(INT64_MAX, UINT64_MAX));
  EXPECT_EQ(subscriber.lost(), 7u);
}

TEST_F(SubscriberTest, DoesNotCountWhatWasLeftOutForTheRate) {
  begin({.max_rate_hz = 10});
  subscriber.set_buffering(true);
  arrive(0);
  arrive(50);
  gap(60, 5);
  EXPECT_EQ(subscriber.lost(), 5u);
  subscriber.on_down();
  subscribed(200);
  EXPECT_EQ(subscriber.lost(), 5u);
}

TEST_F(SubscriberTest, TheNewestOnlyIsARateThatLeavesOutWithoutLoss) {
  begin({.start = Subscription::Start::oldest, .max_rate_hz = Subscription::kNewestOnly});
  EXPECT_EQ(request().max_rate_hz(), Subscription::kNewestOnly);
  subscriber.set_buffering(true);
  arrive(9);
  arrive(12);
  EXPECT_EQ(subscriber.lost(), 0u);
  expect_kept(9);
  expect_kept(12);
}

TEST_F(SubscriberTest, ATornSampleIsNeverGivenOut) {
  begin();
  subscriber.set_target(target.data());
  EXPECT_TRUE(arrive(0, true));
  EXPECT_FALSE(subscriber.delivered(info));
  EXPECT_TRUE(arrive(1)) << "the target is still free";
  EXPECT_TRUE(subscriber.delivered(info));
  EXPECT_EQ(subscriber.lost(), 1u);
}

TEST_F(SubscriberTest, ReportsANewRingAfterTheOldOnesSamples) {
  begin();
  subscriber.set_buffering(true);
  arrive(0);
  arrive(1);
  subscriber.on_down();
  subscriber.on_restart();
  EXPECT_TRUE(request().from_oldest());
  subscribed(0);
  arrive(0);
  expect_kept(0);
  expect_kept(1);
  EXPECT_EQ(subscriber.pop_buffered(target, info), ReadStatus::restarted);
  expect_kept(0);
  EXPECT_FALSE(subscriber.pop_buffered(target, info));
  EXPECT_EQ(subscriber.lost(), 0u);
}

TEST_F(SubscriberTest, ReportsANewRingAlsoWhenTheQueueOverflows) {
  Subscriber small(16U << 20);  // one sample fills the queue
  small.begin({});
  ASSERT_TRUE(small.on_subscribed_untrusted(0));
  small.set_buffering(true);
  std::byte* out = nullptr;
  ASSERT_TRUE(small.on_sample_begin({0, {}, {}}, out));
  small.on_sample_end({0, {}, {}}, false);
  small.on_down();
  small.on_restart();
  ASSERT_TRUE(small.on_subscribed_untrusted(0));
  ASSERT_TRUE(small.on_sample_begin({0, {}, {}}, out));
  small.on_sample_end({0, {}, {}}, false);
  EXPECT_EQ(small.lost(), 1u);
  std::vector<std::byte> payload(16U << 20);
  EXPECT_EQ(small.pop_buffered(payload, info), ReadStatus::restarted);
  EXPECT_EQ(small.pop_buffered(payload, info), ReadStatus::ok);
}

TEST_F(SubscriberTest, RefusesTidsThatFallAndTheOneThatHasNoSuccessor) {
  begin();
  subscriber.set_buffering(true);
  arrive(7);
  std::byte* out = nullptr;
  EXPECT_EQ(subscriber.on_sample_begin({7, {}, {}}, out).error().code, Errc::protocol);
  EXPECT_EQ(subscriber.on_sample_begin({INT64_MAX, {}, {}}, out).error().code, Errc::protocol);
  EXPECT_EQ(subscriber.on_subscribed_untrusted(-1).error().code, Errc::protocol);
}

TEST_F(SubscriberTest, PutsAsideTheSampleThatFillsTheTarget) {
  begin();
  subscriber.set_target(target.data());
  std::byte* out = nullptr;
  const SampleInfo stamps{3, {}, {}, bytes_of(3)};
  ASSERT_TRUE(subscriber.on_sample_begin(stamps, out));
  EXPECT_EQ(out, target.data());
  EXPECT_TRUE(subscriber.is_filling_target());
  out = subscriber.detach_target();
  EXPECT_FALSE(subscriber.is_filling_target());
  subscriber.set_target(nullptr);
  const Tid tid = 3;
  std::memcpy(out, &tid, sizeof tid);
  subscriber.on_sample_end(stamps, false);
  expect_kept(3);
}

TEST_F(SubscriberTest, ANewSubscriptionReplacesTheOldOne) {
  begin();
  subscriber.set_buffering(true);
  arrive(0);
  subscriber.begin({.start = Subscription::Start::oldest});
  EXPECT_FALSE(subscriber.has_buffered());
  EXPECT_TRUE(arrive(1)) << "of the old one: thrown away";
  EXPECT_FALSE(subscriber.has_buffered());
  subscribed(0);
  arrive(0);
  expect_kept(0);
}

// --- SampleQueue

using Payload = std::array<std::byte, 8>;

Payload payload_of(Tid tid) {
  Payload payload;
  std::memcpy(payload.data(), &tid, sizeof tid);
  return payload;
}

void push(SampleQueue& queue, Tid tid) {
  const Payload payload = payload_of(tid);
  std::memcpy(queue.place(), payload.data(), payload.size());
  queue.push({tid, time_from_ns(tid * 10), Duration(5), payload.size()});
}

void expect_pop(SampleQueue& queue, Tid tid) {
  ASSERT_FALSE(queue.empty());
  Payload payload{};
  SampleInfo info;
  queue.pop(payload, info);
  EXPECT_EQ(info.tid, tid);
  EXPECT_EQ(info.time, time_from_ns(tid * 10));
  EXPECT_EQ(payload, payload_of(tid));
}

TEST(SampleQueue, GivesBackWhatItTookInOrderOverManyTurns) {
  SampleQueue queue(8, 1 << 20);
  Tid in = 0, out = 0;
  for (int round = 1; round < 200; ++round) {
    for (int i = 0; i < round; ++i) push(queue, in++);
    for (int i = 0; i < round; ++i) expect_pop(queue, out++);
  }
  EXPECT_TRUE(queue.empty());
  EXPECT_EQ(queue.dropped(), 0u);
  EXPECT_EQ(queue.removed(), static_cast<std::uint64_t>(in));
}

TEST(SampleQueue, GrowsInTheMidstOfATurn) {
  SampleQueue queue(8, 1 << 20);
  Tid in = 0, out = 0;
  for (int i = 0; i < 10; ++i) push(queue, in++);
  for (int i = 0; i < 10; ++i) expect_pop(queue, out++);
  for (int i = 0; i < 300; ++i) push(queue, in++);
  EXPECT_EQ(queue.size(), 300u);
  while (out < in) expect_pop(queue, out++);
}

TEST(SampleQueue, DropsAndCountsTheOldestBeyondItsLimit) {
  SampleQueue queue(8, 10 * 8);
  for (Tid tid = 0; tid < 25; ++tid) push(queue, tid);
  EXPECT_EQ(queue.size(), 10u);
  EXPECT_EQ(queue.dropped(), 15u);
  EXPECT_EQ(queue.removed(), 15u);
  for (Tid tid = 15; tid < 25; ++tid) expect_pop(queue, tid);
}

TEST(SampleQueue, KeepsAllWhenOneThatArrivesIsGivenUp) {
  SampleQueue queue(8, 10 * 8);
  for (Tid tid = 0; tid < 10; ++tid) push(queue, tid);
  std::memcpy(queue.place(), payload_of(77).data(), 8);
  std::memcpy(queue.place(), payload_of(78).data(), 8);
  EXPECT_EQ(queue.dropped(), 0u);
  for (Tid tid = 0; tid < 10; ++tid) expect_pop(queue, tid);
}

TEST(SampleQueue, KeepsOneSampleThatIsLargerThanItsLimit) {
  SampleQueue queue(8, 1);
  push(queue, 1);
  push(queue, 2);
  EXPECT_EQ(queue.dropped(), 1u);
  expect_pop(queue, 2);
}

TEST(SampleQueue, AnArrivingSampleStaysInPlaceWhileOthersAreTaken) {
  SampleQueue queue(8, 10 * 8);
  push(queue, 0);
  push(queue, 1);
  std::byte* const place = queue.place();
  expect_pop(queue, 0);
  std::memcpy(place, payload_of(2).data(), 8);
  queue.push({2, time_from_ns(20), Duration(5), 8});
  expect_pop(queue, 1);
  expect_pop(queue, 2);
}

}  // namespace
}  // namespace dssm::detail
