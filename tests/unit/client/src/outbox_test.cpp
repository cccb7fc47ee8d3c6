// SPDX-License-Identifier: Apache-2.0
//
// The outbox against a model of the owner's end: bytes go over in pieces of any size, connections
// break anywhere, and in the end every posted sample was written once or is counted as dropped.
#include "client/src/outbox.hpp"

#include <gtest/gtest.h>

#include <cstring>
#include <random>
#include <set>

#include "core/wire/frame.hpp"
#include "network.pb.h"

namespace dssm::detail {
namespace {

constexpr std::size_t kPayloadBytes = 8;

// Some samples are shorter than the stream's.
std::string payload_numbered(std::int64_t value) {
  const auto bytes = static_cast<std::size_t>(value % 5 == 3 ? value % 8 : 8);
  return std::string(bytes, static_cast<char>('a' + value % 26));
}

std::int64_t push(Outbox& outbox, std::int64_t value) {
  const std::string payload = payload_numbered(value);
  return outbox.push(std::as_bytes(std::span(payload)), time_from_ns(value * 10), Duration(3));
}

// The owner's end: takes bytes, writes each sample once.
class Owner {
 public:
  void connect() { input_ = wire::FrameBuffer(1 << 20); }

  void take(std::span<const std::byte> bytes) {
    const auto space = input_.space();
    ASSERT_LE(bytes.size(), space.size());
    std::memcpy(space.data(), bytes.data(), bytes.size());
    input_.commit(bytes.size());
    for (;;) {
      auto message = input_.next();
      ASSERT_TRUE(message) << message.error().message;
      if (!*message) return;
      net::Frame frame;
      ASSERT_TRUE(frame.ParseFromArray((*message)->data(), static_cast<int>((*message)->size())));
      const std::int64_t value = frame.sample().tid();  // numbers are what was posted
      EXPECT_EQ(frame.payload(), payload_numbered(value));
      EXPECT_EQ(frame.sample().time_ns(), value * 10);
      EXPECT_EQ(frame.sample().clock_error_ns(), 3u);
      EXPECT_EQ(frame.serial(), 0u);
      if (value <= last) continue;
      last = value;
      written.push_back(value);
    }
  }

  std::int64_t last = -1;
  std::vector<std::int64_t> written;
  Tid tid() const { return static_cast<Tid>(written.size()) - 1; }

 private:
  wire::FrameBuffer input_{1 << 20};
};

// Sends up to `limit` bytes.
void send(Outbox& outbox, Owner& owner, std::size_t limit) {
  while (limit > 0) {
    const auto bytes = outbox.unsent();
    if (bytes.empty()) return;
    const std::size_t count = std::min(limit, bytes.size());
    owner.take(bytes.first(std::min<std::size_t>(count, 4096)));
    outbox.sent(std::min<std::size_t>(count, 4096));
    limit -= std::min<std::size_t>(count, 4096);
  }
}

TEST(Outbox, SendsAgainWhatANewConnectionHasNotSeen) {
  Outbox outbox(kPayloadBytes, 100, 1 << 20);
  Owner owner;
  for (int i = 0; i < 10; ++i) EXPECT_EQ(push(outbox, i), i);
  send(outbox, owner, 215);  // some, and a piece
  const std::int64_t seen = owner.last;
  EXPECT_GE(seen, 2);
  EXPECT_LT(seen, 9);
  EXPECT_FALSE(outbox.rest_of_frame().empty());
  outbox.on_down();
  EXPECT_TRUE(outbox.rest_of_frame().empty());
  owner.connect();
  ASSERT_TRUE(outbox.restart(owner.last, owner.tid()));
  send(outbox, owner, 1 << 20);
  ASSERT_TRUE(outbox.acknowledge(owner.last, owner.tid()));
  EXPECT_TRUE(outbox.all_written());
  EXPECT_EQ(outbox.written_tid(), 9);
  EXPECT_EQ(owner.written.size(), 10u);
  EXPECT_EQ(outbox.dropped(), 0u);
}

TEST(Outbox, DropsTheOldestThatWasNotSentAndEndsTheFrameThatWasBegun) {
  Outbox outbox(kPayloadBytes, 3, 1 << 20);
  Owner owner;
  for (int i = 0; i < 3; ++i) push(outbox, i);
  send(outbox, owner, 5);  // a piece of sample 0
  push(outbox, 3);         // 0 makes room, but goes on being sent
  push(outbox, 4);         // 1 is dropped
  EXPECT_EQ(outbox.dropped(), 1u);
  send(outbox, owner, 1 << 20);
  EXPECT_EQ(owner.written, (std::vector<std::int64_t>{0, 2, 3, 4}));
  ASSERT_TRUE(outbox.acknowledge(4, 3));
  EXPECT_TRUE(outbox.all_written());
  EXPECT_EQ(outbox.dropped(), 1u);
}

TEST(Outbox, CountsWhatWasSentButNeverWrittenWhenItIsTooLateToSendItAgain) {
  Outbox outbox(kPayloadBytes, 2, 1 << 20);
  Owner owner;
  for (int i = 0; i < 2; ++i) push(outbox, i);
  send(outbox, owner, 1 << 20);
  for (int i = 2; i < 4; ++i) push(outbox, i);  // in place of 0 and 1, of which nothing is known
  EXPECT_EQ(outbox.dropped(), 0u);
  outbox.on_down();
  owner.connect();
  ASSERT_TRUE(outbox.restart(0, 0));  // 1 was lost with the connection
  EXPECT_EQ(outbox.dropped(), 1u);
}

TEST(Outbox, KeepsOneSampleThatIsLargerThanItsLimit) {
  Outbox outbox(kPayloadBytes, 100, 1);
  push(outbox, 0);
  push(outbox, 1);
  Owner owner;
  send(outbox, owner, 1 << 20);
  EXPECT_EQ(owner.written, std::vector<std::int64_t>{1});
  EXPECT_EQ(outbox.dropped(), 1u);
}

TEST(Outbox, RefusesAnAcknowledgementOfWhatWasNeverPosted) {
  Outbox outbox(kPayloadBytes, 100, 1 << 20);
  push(outbox, 0);
  EXPECT_EQ(outbox.acknowledge(1, 0).error().code, Errc::protocol);
  EXPECT_EQ(outbox.restart(INT64_MAX, 0).error().code, Errc::protocol);
}

TEST(Outbox, NeverDropsASampleBecauseOfAStrangeAcknowledgement) {
  Outbox outbox(kPayloadBytes, 100, 1 << 20);
  Owner owner;
  for (int i = 0; i < 4; ++i) push(outbox, i);
  ASSERT_TRUE(outbox.acknowledge(-5, 7));
  send(outbox, owner, 1 << 20);
  EXPECT_EQ(owner.written.size(), 4u);
  // Written by what was still under way on the connection before: skipped here.
  for (int i = 4; i < 8; ++i) push(outbox, i);
  ASSERT_TRUE(outbox.acknowledge(5, 5));
  owner.last = 5;
  owner.written.insert(owner.written.end(), {4, 5});
  send(outbox, owner, 1 << 20);
  EXPECT_EQ(owner.written, (std::vector<std::int64_t>{0, 1, 2, 3, 4, 5, 6, 7}));
}

TEST(Outbox, EachSampleIsWrittenOnceOrCountedWhateverBreaks) {
  const std::random_device::result_type seed = std::random_device()();
  SCOPED_TRACE(testing::Message() << "seed " << seed);
  std::mt19937_64 random(seed);
  for (int run = 0; run < 200; ++run) {
    Outbox outbox(kPayloadBytes, 1 + random() % 40, 1 << 20);
    Owner owner;
    std::int64_t posted = 0;
    bool up = true;
    for (int step = 0; step < 500; ++step) {
      switch (random() % 8) {
        case 0:
        case 1:
        case 2:
          for (auto n = random() % 6; n > 0; --n) push(outbox, posted++);
          break;
        case 3:
        case 4:
          if (up) send(outbox, owner, random() % 300);
          break;
        case 5:
          if (up) {
            ASSERT_TRUE(outbox.acknowledge(owner.last, owner.tid()));
          }
          break;
        case 6:
          if (random() % 4 == 0) {
            up = false;
            outbox.on_down();
          }
          break;
        default:
          if (up) break;
          up = true;
          owner.connect();
          ASSERT_TRUE(outbox.restart(owner.last, owner.tid()));
          break;
      }
    }
    outbox.on_down();
    owner.connect();
    ASSERT_TRUE(outbox.restart(owner.last, owner.tid()));
    send(outbox, owner, 1 << 30);
    ASSERT_TRUE(outbox.acknowledge(owner.last, owner.tid()));
    ASSERT_TRUE(outbox.all_written());
    const std::set<std::int64_t> once(owner.written.begin(), owner.written.end());
    ASSERT_EQ(once.size(), owner.written.size());
    ASSERT_EQ(owner.written.size() + outbox.dropped(), static_cast<std::uint64_t>(posted));
    if (posted > 0) {
      ASSERT_EQ(owner.last, posted - 1);
      ASSERT_EQ(outbox.written_tid(), owner.tid());
    }
  }
}

}  // namespace
}  // namespace dssm::detail
