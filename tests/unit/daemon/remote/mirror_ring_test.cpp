// SPDX-License-Identifier: Apache-2.0
#include "daemon/remote/mirror_ring.hpp"

#include <gtest/gtest.h>

#include <cstring>

#include "daemon/link/sample_pump.hpp"
#include "tests/unit/daemon/daemon_fixtures.hpp"

namespace dssm::daemon {
namespace {

constexpr std::uint64_t kDepth = 16;

std::vector<std::byte> payload_of(Tid tid) {
  return std::vector<std::byte>(24, static_cast<std::byte>(tid));
}

class MirrorRingTest : public testing::Test {
 protected:
  MemoryBudget budget{1 << 20};
  std::shared_ptr<Stream> stream = Stream::create({.id = {"odometry", 0, "pc2"},
                                                   .type = odometry_type(),
                                                   .depth = kDepth,
                                                   .cycle = std::chrono::milliseconds(10),
                                                   .purpose = Purpose::mirror,
                                                   .incarnation = 7},
                                                  budget)
                                       .value();
  std::unique_ptr<MirrorRing> ring = MirrorRing::open(stream, budget).value();
  ring::RingReader reader{stream->mapping()};

  static wire::IncomingSample incoming(Tid tid) {
    return {0, {tid, time_from_ns(1000 + tid), Duration(tid)}, 24};
  }
  Result<void> take(Tid tid, bool torn = false) {
    const wire::IncomingSample sample = incoming(tid);
    Result<std::byte*> place = ring->begin_untrusted(sample);
    if (!place) return std::move(place).error();
    std::memcpy(*place, payload_of(tid).data(), 24);
    ring->end(sample, torn);
    return {};
  }
  // The sample that it asks the owner for; kNoTid: the oldest.
  Tid wanted() const {
    net::Subscribe request;
    ring->resume(request);
    return request.from_oldest() ? kNoTid : request.from_tid();
  }
  ReadStatus read(Tid tid) {
    std::vector<std::byte> payload(24);
    SampleInfo info;
    const ReadStatus status = reader.read(tid, payload, info);
    if (status == ReadStatus::ok) {
      EXPECT_EQ(info.tid, tid);
      EXPECT_EQ(to_ns(info.time), 1000 + tid);
      EXPECT_EQ(to_ns(info.clock_error), tid);
      EXPECT_EQ(payload, payload_of(tid));
    }
    return status;
  }
};

TEST_F(MirrorRingTest, RepeatsTheOwnersTidsWhereverTheyBegin) {
  EXPECT_EQ(wanted(), kNoTid) << "nothing known: the oldest is wanted";
  ASSERT_TRUE(ring->on_subscribed_untrusted(1000));
  for (Tid tid = 1000; tid < 1010; ++tid) ASSERT_TRUE(take(tid));
  EXPECT_EQ(reader.oldest(), 1000);
  EXPECT_EQ(reader.newest(), 1009);
  for (Tid tid = 1000; tid < 1010; ++tid) EXPECT_EQ(read(tid), ReadStatus::ok);
  EXPECT_EQ(wanted(), 1010);
  EXPECT_EQ(ring->gap_samples(), 0u);
  EXPECT_EQ(ring->received_samples(), 10u);
  EXPECT_EQ(ring->received_bytes(), 240u);
}

TEST_F(MirrorRingTest, NeverShowsATornSampleAndCountsItOnce) {
  ASSERT_TRUE(ring->on_subscribed_untrusted(0));
  ASSERT_TRUE(take(0));
  ASSERT_TRUE(take(1, true));
  EXPECT_EQ(reader.newest(), 0);
  ASSERT_TRUE(take(2));
  EXPECT_EQ(reader.newest(), 2);
  EXPECT_EQ(reader.oldest(), 2) << "the window has no holes";
  EXPECT_NE(read(1), ReadStatus::ok);
  EXPECT_EQ(ring->gap_samples(), 1u);
}

TEST_F(MirrorRingTest, CountsATornSampleThatIsReportedAsAGapOnce) {
  ASSERT_TRUE(ring->on_subscribed_untrusted(0));
  ASSERT_TRUE(take(0));
  ASSERT_TRUE(take(1, true));
  ASSERT_TRUE(ring->on_gap_untrusted(1, 1));
  ASSERT_TRUE(take(2));
  EXPECT_EQ(ring->gap_samples(), 1u);
}

TEST_F(MirrorRingTest, CountsReportedAndUnreportedGapsAlike) {
  ASSERT_TRUE(ring->on_subscribed_untrusted(0));
  ASSERT_TRUE(take(0));
  ASSERT_TRUE(ring->on_gap_untrusted(1, 9));
  EXPECT_EQ(ring->gap_samples(), 9u) << "before anything comes behind it";
  EXPECT_EQ(wanted(), 10) << "a cut now resumes behind the gap";
  ASSERT_TRUE(take(10));
  ASSERT_TRUE(take(15));  // untold
  EXPECT_EQ(ring->gap_samples(), 13u);
}

TEST_F(MirrorRingTest, CountsWhatTheOwnerLostWhileTheLinkWasCut) {
  ASSERT_TRUE(ring->on_subscribed_untrusted(0));
  ASSERT_TRUE(take(0));
  ASSERT_TRUE(ring->on_subscribed_untrusted(100));  // after a reconnect: the oldest it still has
  ASSERT_TRUE(take(100));
  EXPECT_EQ(ring->gap_samples(), 99u);
}

TEST_F(MirrorRingTest, KeepsTheWindowWholeWhileASampleAfterAGapArrives) {
  ASSERT_TRUE(ring->on_subscribed_untrusted(0));
  for (Tid tid = 0; tid < 20; ++tid) ASSERT_TRUE(take(tid));
  for (const Tid behind : {22, 28, 33, 35}) {  // their slots hold 6, 12, 17 and the newest
    const wire::IncomingSample sample = incoming(behind);
    ASSERT_TRUE(ring->begin_untrusted(sample));
    for (Tid tid = reader.oldest(); tid <= reader.newest(); ++tid) {
      EXPECT_EQ(read(tid), ReadStatus::ok) << tid << " while " << behind << " arrives";
    }
    ring->end(sample, true);
  }
  ASSERT_TRUE(take(35));
  EXPECT_EQ(reader.oldest(), 35);
  EXPECT_EQ(read(35), ReadStatus::ok);
  EXPECT_EQ(ring->gap_samples(), 15u);
}

TEST_F(MirrorRingTest, DoesNotTakeWhatWasCutOffForTheNextSample) {
  ASSERT_TRUE(ring->on_subscribed_untrusted(0));
  for (Tid tid = 0; tid < 20; ++tid) ASSERT_TRUE(take(tid));
  const std::uint64_t used = budget.used();
  ASSERT_TRUE(ring->begin_untrusted(incoming(28)));  // aside; then the connection breaks
  EXPECT_EQ(budget.used(), used + 24);
  ASSERT_TRUE(take(20));  // the owner has it still
  EXPECT_EQ(read(20), ReadStatus::ok);
  EXPECT_EQ(budget.used(), used);
  EXPECT_EQ(ring->gap_samples(), 0u);
}

TEST_F(MirrorRingTest, ReceivesInPlaceWhenThereIsNoMemoryToSetAside) {
  ASSERT_TRUE(ring->on_subscribed_untrusted(0));
  for (Tid tid = 0; tid < 20; ++tid) ASSERT_TRUE(take(tid));
  const MemoryShare rest = budget.take(budget.limit() - budget.used()).value();
  ASSERT_TRUE(take(28));
  EXPECT_EQ(read(28), ReadStatus::ok);
}

TEST_F(MirrorRingTest, RefusesTidsThatDoNotRise) {
  EXPECT_FALSE(ring->on_subscribed_untrusted(-1));
  EXPECT_FALSE(ring->on_subscribed_untrusted(channel::kMaxTid + 1));
  ASSERT_TRUE(ring->on_subscribed_untrusted(5));
  ASSERT_TRUE(take(5));
  EXPECT_EQ(take(5).error().code, Errc::protocol);
  EXPECT_EQ(take(4).error().code, Errc::protocol);
  EXPECT_EQ(take(channel::kMaxTid + 1).error().code, Errc::protocol);
  EXPECT_EQ(ring->on_gap_untrusted(3, 2).error().code, Errc::protocol);
  EXPECT_EQ(ring->on_gap_untrusted(-1, 20).error().code, Errc::protocol);
  EXPECT_EQ(ring->on_gap_untrusted(0, ~std::uint64_t{0}).error().code, Errc::protocol);
  EXPECT_EQ(ring->gap_samples(), 0u);
}

TEST_F(MirrorRingTest, ContinuesAfterWhatAnEarlierDssmdReceived) {
  ASSERT_TRUE(ring->on_subscribed_untrusted(0));
  for (Tid tid = 0; tid < 40; ++tid) ASSERT_TRUE(take(tid));
  ASSERT_TRUE(ring->begin_untrusted(incoming(40)));  // dies here
  ring = MirrorRing::open(stream, budget).value();
  EXPECT_EQ(wanted(), 40);
  EXPECT_EQ(read(39), ReadStatus::ok);
  ASSERT_TRUE(take(40));
  EXPECT_EQ(read(40), ReadStatus::ok);
  EXPECT_EQ(ring->gap_samples(), 0u);
}

TEST_F(MirrorRingTest, WakesSleepersOncePerBatch) {
  auto bell = stream->map_bell().value();
  ASSERT_TRUE(ring->on_subscribed_untrusted(0));
  const std::uint32_t announced = bell->announce();
  ASSERT_TRUE(take(0));
  ASSERT_TRUE(take(1));
  EXPECT_EQ(bell->announce(), announced) << "not before the batch is complete";
  ring->wake();
  EXPECT_NE(bell->announce(), announced);
  const std::uint32_t again = bell->announce();
  ring->wake();
  EXPECT_EQ(bell->announce(), again) << "nothing new came";
}

}  // namespace
}  // namespace dssm::daemon
