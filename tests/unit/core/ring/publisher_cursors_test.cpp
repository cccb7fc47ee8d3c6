// SPDX-License-Identifier: Apache-2.0
#include "core/ring/publisher_cursors.hpp"

#include <limits>

#include "tests/unit/core/ring/test_ring.hpp"

namespace dssm::ring {
namespace {

class PublisherNotesTest : public testing::Test {
 protected:
  // Writes sample `number` of `publisher`; returns its tid.
  Tid publish(std::uint64_t publisher, std::int64_t number) {
    RingWriter writer = ring.writer();
    return writer.try_publish({publisher, number}, payload_for(0, 8), time_from_ns(1), Duration(0));
  }
  std::int64_t number(std::uint64_t publisher) { return cursors.last_untrusted(publisher).number; }
  Tid tid(std::uint64_t publisher) { return cursors.last_untrusted(publisher).tid; }

  const TestRing ring{8, 4};
  const PublisherCursors cursors{ring.mapping->header()};
};

TEST_F(PublisherNotesTest, KnowWhereEachStopped) {
  for (const std::uint64_t publisher : {0, 5}) {
    EXPECT_EQ(number(publisher), -1);
    EXPECT_EQ(tid(publisher), kNoTid);
  }
  EXPECT_EQ(publish(5, 10), 0);
  EXPECT_EQ(publish(0, 0), 1);
  ring.writer().write(payload_for(0, 8), {}, {});
  EXPECT_EQ(publish(5, 12), 3);
  EXPECT_EQ(number(5), 12);
  EXPECT_EQ(tid(5), 3);
  EXPECT_EQ(number(0), 0);
  EXPECT_EQ(tid(0), 1);
  EXPECT_EQ(number(6), -1);
}

// As another process, or the next dssmd, sees it.
TEST_F(PublisherNotesTest, LiveInTheRing) {
  publish(5, 10);
  const auto other = RingMapping::open_untrusted(ring.fd.get(), Access::read_only).value();
  EXPECT_EQ(PublisherCursors(other->header()).last_untrusted(5).number, 10);
}

TEST_F(PublisherNotesTest, ReplaceTheOneThatWroteLongestAgo) {
  for (std::uint64_t i = 0; i < kMaxPublishers; ++i) publish(i, 7);
  publish(0, 8);
  publish(1000, 1);
  EXPECT_EQ(number(0), 8);
  EXPECT_EQ(number(1), -1) << "it made room";
  EXPECT_EQ(number(2), 7);
  EXPECT_EQ(number(1000), 1);
}

TEST_F(PublisherNotesTest, TakeTheLargestNumbers) {
  constexpr std::int64_t kLargest = std::numeric_limits<std::int64_t>::max();
  publish(~std::uint64_t{0}, kLargest);
  EXPECT_EQ(number(~std::uint64_t{0}), kLargest);
}

// A dssmd that died between the cursor and the sample.
TEST_F(PublisherNotesTest, DoNotCountASampleThatIsNotThere) {
  publish(5, 10);
  cursors.advance({5, 11}, 1);
  cursors.advance({6, 0}, 1);
  for (int recovered = 0; recovered < 3; ++recovered) {
    EXPECT_EQ(number(5), 10);
    EXPECT_EQ(tid(5), 0);
    EXPECT_EQ(number(6), -1);
    EXPECT_EQ(tid(6), kNoTid);
    cursors.recover();  // what the next holder of the lock does, if it is not killed in between
  }
  EXPECT_EQ(ring.writer().write(payload_for(0, 8), {}, {}), 1) << "another one has its tid now";
  EXPECT_EQ(number(5), 10);
  EXPECT_EQ(number(6), -1);
  EXPECT_EQ(publish(5, 11), 2);
  EXPECT_EQ(number(5), 11);
}

TEST_F(PublisherNotesTest, DoNotGiveANewPublisherWhatAForgottenOneWrote) {
  for (std::uint64_t i = 0; i < kMaxPublishers; ++i) publish(i, 7);
  cursors.advance({1000, 1}, static_cast<Tid>(kMaxPublishers));
  EXPECT_EQ(number(1000), -1);
  EXPECT_EQ(number(0), -1);
  cursors.recover();
  EXPECT_EQ(number(1000), -1);
  EXPECT_EQ(number(1), 7);
}

TEST_F(PublisherNotesTest, NonsenseOfAProgramIsNoNote) {
  publish(5, 10);
  PublisherCursor& cursor = ring.mapping->header().publishers[0];
  constexpr std::uint64_t kAll = ~std::uint64_t{0};
  for (const std::uint64_t nonsense : {std::uint64_t{3}, kAll >> 1, kAll}) {
    cursor.tid_end.store(nonsense);
    cursor.earlier_tid_end.store(nonsense);
    EXPECT_EQ(number(5), -1);
    EXPECT_EQ(tid(5), kNoTid);
  }
  cursor.tid_end.store(1);
  cursor.number_end.store(kAll);
  EXPECT_EQ(number(5), -1);
  cursor.tid_end.store(kAll);
  cursors.recover();
  EXPECT_EQ(publish(5, 11), 1);
  EXPECT_EQ(number(5), 11);
  ring.mapping->header().top.store(std::numeric_limits<std::int64_t>::max());
  EXPECT_EQ(number(5), 11);
}

}  // namespace
}  // namespace dssm::ring
