// SPDX-License-Identifier: Apache-2.0
#include "client/src/sample_queue.hpp"

#include <gtest/gtest.h>

#include <array>
#include <cstring>

namespace dssm::detail {
namespace {

using Payload = std::array<std::byte, 8>;

Payload payload_of(Tid tid) {
  Payload payload;
  std::memcpy(payload.data(), &tid, sizeof tid);
  return payload;
}

void push(SampleQueue& queue, Tid tid) {
  const Payload payload = payload_of(tid);
  std::memcpy(queue.place(), payload.data(), payload.size());
  queue.push({tid, time_from_ns(tid * 10), Duration(5)});
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
  queue.push({2, time_from_ns(20), Duration(5)});
  expect_pop(queue, 1);
  expect_pop(queue, 2);
}

}  // namespace
}  // namespace dssm::detail
