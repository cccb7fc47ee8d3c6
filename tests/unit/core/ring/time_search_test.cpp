// SPDX-License-Identifier: Apache-2.0
//
// Search by time against a plain model, for streams that behave and streams that do not.
#include "core/ring/time_search.hpp"

#include <functional>
#include <random>

#include "tests/unit/core/ring/test_ring.hpp"

namespace dssm::ring {
namespace {

// What docs/ring-layout.md promises: the greatest tid of the window with time <= t.
Tid expected(const std::vector<std::int64_t>& times, Tid oldest, std::int64_t t) {
  for (Tid tid = static_cast<Tid>(times.size()) - 1; tid >= oldest; --tid) {
    if (times[static_cast<std::size_t>(tid)] <= t) return tid;
  }
  return kNoTid;
}

using NextTime = std::function<std::int64_t(std::int64_t previous, std::mt19937_64&)>;

struct Shape {
  const char* name;
  NextTime next;
};

std::int64_t below(std::mt19937_64& random, std::int64_t limit) {
  return static_cast<std::int64_t>(random() % static_cast<std::uint64_t>(limit));
}

const Shape kShapes[] = {
    {"regular", [](auto last, auto&) { return last + 1000; }},
    {"jittery", [](auto last, auto& random) { return last + 900 + below(random, 200); }},
    {"equal", [](auto last, auto& random) { return last + below(random, 2); }},
    {"gaps", [](auto last, auto& random) { return last + (below(random, 50) ? 1000 : 5'000'000); }},
    {"exponential", [](auto last, auto& random) { return last + (1LL << below(random, 40)); }},
    {"rare steps back",
     [](auto last, auto& random) { return last + (below(random, 40) ? 1000 : -20'000); }},
    {"replay in a loop",
     [](auto last, auto& random) { return below(random, 60) ? last + 1000 : 0; }},
    {"always backwards", [](auto last, auto&) { return last - 10; }},
    {"sawtooth up",
     [up = std::int64_t{0}](auto last, auto&) mutable { return last + (++up % 2 ? 50 : -47); }},
    {"random walk", [](auto last, auto& random) { return last + below(random, 2001) - 1000; }},
    {"anything", [](auto, auto& random) { return below(random, 1'000'000); }},
    {"extremes",
     [](auto, auto& random) {
       const std::int64_t values[] = {INT64_MIN, INT64_MIN + 1, -1, 0, 1, INT64_MAX - 1, INT64_MAX};
       return values[random() % 7];
     }},
};

TEST(TimeSearch, FindsTheNewestSampleAtOrBeforeAnyTimeInEveryShapeOfStream) {
  const std::uint64_t seed = std::random_device{}();
  std::mt19937_64 random(seed);
  for (const Shape& shape : kShapes) {
    for (const std::uint64_t depth : {2, 3, 5, 17, 100, 1000}) {
      SCOPED_TRACE(testing::Message() << shape.name << ", depth " << depth << ", seed " << seed);
      const TestRing ring(8, depth);
      const RingReader reader = ring.reader();
      RingWriter writer = ring.writer();
      std::vector<std::int64_t> times;
      NextTime next = shape.next;
      std::int64_t time = 500'000;
      const int writes = static_cast<int>(3 * depth + 20);
      for (int i = 0; i < writes; ++i) {
        time = next(time, random);
        times.push_back(time);
        writer.write(payload_for(i, 8), time_from_ns(time), Duration(0));
        const int questions = depth <= 17 || i == writes - 1 ? 40 : 2;
        for (int q = 0; q < questions; ++q) {
          const Tid oldest = reader.oldest();
          std::int64_t t = times[static_cast<std::size_t>(below(random, i + 1))];
          if (q % 4 == 1 && t < INT64_MAX) t += 1;
          if (q % 4 == 2 && t > INT64_MIN) t -= 1;
          if (q % 4 == 3) t = below(random, 3'000'000) - 100'000;
          Tid found = kNoTid;
          const ReadStatus status = reader.find(time_from_ns(t), found);
          const Tid wanted = expected(times, oldest, t);
          ASSERT_EQ(found, wanted) << "t " << t << " at tid " << i;
          ASSERT_EQ(status, wanted == kNoTid ? ReadStatus::too_old : ReadStatus::ok);
        }
      }
    }
  }
}

// The number of steps, not of nanoseconds: a stream that alternates backwards and forwards has a
// run for every other sample, and a search must not walk them one by one.
TEST(TimeSearch, TakesLogarithmicallyManyHopsOverRuns) {
  const std::uint64_t depth = 1 << 16;
  const TestRing ring(1, depth);
  RingWriter writer = ring.writer();
  const std::byte payload[1] = {};
  std::int64_t time = 0;
  for (std::uint64_t i = 0; i < depth; ++i) {
    time += i % 2 ? -40 : 50;
    writer.write(payload, time_from_ns(time), Duration(0));
  }
  const RingReader reader = ring.reader();
  const SlotTable slots(*ring.mapping);
  const Tid top = reader.newest();
  // kMaxHops is 512; a walk over 32768 runs would be given up as lapped.
  for (const std::int64_t t : {-39, 0, 11, 1000, 40'000, 200'000}) {
    const Tid run = slots.slot(top).run_start.load();
    const FoundSample found = find_newest_at_or_before(slots, reader.oldest(), top, run, t);
    ASSERT_NE(found.status, ReadStatus::lapped) << t;
    if (t >= 10) {
      ASSERT_EQ(found.status, ReadStatus::ok);
      ASSERT_LE(slots.time_ns(found.tid).load(), t);
    }
  }
}

TEST(TimeSearch, GivesUpOnLinksThatAHostileWriterMadeCircular) {
  const TestRing ring(8, 64);
  RingWriter writer = ring.writer();
  for (int i = 0; i < 64; ++i) writer.write(payload_for(i, 8), time_from_ns(1000 - i), Duration(0));
  const SlotTable slots(*ring.mapping);
  std::mt19937_64 random(7);
  for (int round = 0; round < 20'000; ++round) {
    SlotHeader& slot = slots.slot(static_cast<Tid>(random() % 64));
    const auto value = static_cast<std::int64_t>(random() % 4 ? random() % 80 : random());
    (random() % 3 == 0 ? slot.run_jump
     : random() % 2    ? slot.run_parent
                       : slot.run_start)
        .store(value);
    if (random() % 8 == 0) ring.mapping->header().run_start.store(static_cast<Tid>(random() % 64));
    Tid found = kNoTid;
    (void)ring.reader().find(time_from_ns(static_cast<std::int64_t>(random() % 1100)), found);
    ASSERT_LE(found, 63);
    ASSERT_GE(found, kNoTid);
  }
}

}  // namespace
}  // namespace dssm::ring
