// SPDX-License-Identifier: Apache-2.0
//
// Search by time against a plain model, for streams that behave and streams that do not.
#include "core/ring/time_search.hpp"

#include <algorithm>
#include <array>
#include <functional>
#include <random>

#include "core/ring/slot_writer.hpp"
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

// A mirror that gets the newest samples first, as SamplePump sends them.
class MirrorWithHole {
 public:
  MirrorWithHole(const Shape& shape, std::uint64_t depth, std::mt19937_64& random)
      : shape_(shape), depth_(static_cast<Tid>(depth)), random_(random), ring_(8, depth) {}

  // The owner writes some samples, and only the newest one is sent. The others come later, or
  // never.
  void write(bool loses) {
    const Tid begin = next();
    for (std::int64_t count = 1 + below(random_, 4); count > 0; --count) {
      times_.push_back(shape_.next(times_.empty() ? 0 : times_.back(), random_));
      samples_.push_back(loses ? Sample::lost : Sample::missing);
    }
    const Tid newest = next() - 1;
    fill(newest);
    if (loses && newest > begin && begin > 0) {
      slots_.lose_before_next(newest, time(newest));
      if (begin - 1 < newest - depth_ + 2) first_ = newest;  // none of the older ones stays
    } else if (newest > begin) {
      slots_.skip_to(newest, begin);
    }
    slots_.publish({newest, time(newest), {}, 1});
    sample(newest) = Sample::here;
    if (loses && begin == 0) lose(0, newest);
  }
  // The owner sends the newest ones that it passed over.
  void send_passed_over() {
    Tid end = next();
    while (end > 0 && sample(end - 1) != Sample::missing) --end;
    Tid first = end;
    while (first > 0 && end - first < 5 && sample(first - 1) == Sample::missing) --first;
    for (Tid tid = first; tid < end; ++tid) {
      sample(tid) = Sample::here;
      if (tid < reader_.oldest()) continue;
      fill(tid);
      slots_.publish_in_hole({tid, time(tid), {}, 1});
    }
    slots_.shrink_hole();
  }
  // The owner will not send some of them.
  void lose_some() {
    const Tid first = below(random_, next());
    lose(first, first + below(random_, depth_));
  }
  void lose_what_is_gone() { lose(0, next() - depth_ + 1); }
  void die_and_recover() {
    slots_.recover();
    slots_.unmark_lost();
  }
  bool is_complete() const {
    return std::find(samples_.begin(), samples_.end(), Sample::missing) == samples_.end();
  }

  void check() {
    const Tid top = next() - 1, oldest = reader_.oldest();
    ASSERT_EQ(oldest, std::max<Tid>(first_, top - depth_ + 2));
    if (is_complete()) {
      EXPECT_TRUE(reader_.hole().is_empty() || reader_.hole().end <= oldest);
    }
    for (int i = 0; i < 8; ++i) {
      const std::int64_t t = times_[static_cast<std::size_t>(below(random_, top + 1))] +
                             (i % 2 ? 0 : below(random_, 2000) - 1000);
      Tid wanted = top;
      while (wanted >= oldest && (sample(wanted) == Sample::lost || to_ns(time(wanted)) > t)) {
        --wanted;
      }
      Tid found = kNoTid;
      const ReadStatus status = reader_.find(time_from_ns(t), found);
      if (status == ReadStatus::ok) {
        ASSERT_EQ(found, wanted);
      } else if (status == ReadStatus::arriving) {
        ASSERT_FALSE(is_complete());
      } else {
        ASSERT_EQ(status, ReadStatus::too_old);
        ASSERT_LT(wanted, oldest);
      }
    }
    for (Tid tid = oldest; tid <= top; ++tid) {
      const Sample state = sample(tid);
      ASSERT_EQ(reader_.is_settled(tid), state != Sample::missing) << tid;
      std::array<std::byte, 8> payload{};
      SampleInfo info;
      ASSERT_EQ(reader_.read(tid, payload, info), state == Sample::missing ? ReadStatus::arriving
                                                  : state == Sample::lost  ? ReadStatus::lost
                                                                           : ReadStatus::ok);
      if (state == Sample::here) {
        ASSERT_EQ(info.time, time(tid));
      }
      const Tid next = reader_.skip_lost(tid);
      ASSERT_NE(sample(next), Sample::lost);
      for (Tid between = tid; between < next; ++between) {
        ASSERT_EQ(sample(between), Sample::lost);
      }
    }
  }

 private:
  Time time(Tid tid) const { return time_from_ns(times_[static_cast<std::size_t>(tid)]); }
  void fill(Tid tid) {
    slots_.begin(tid);
    slots_.fill(tid, payload_for(tid, 8));
  }

  void lose(Tid first, Tid end) {
    for (Tid tid = first; tid < std::min(end, next()); ++tid) {
      if (sample(tid) == Sample::missing) sample(tid) = Sample::lost;
    }
    slots_.lose_in_hole(first, end);
    slots_.shrink_hole();
  }
  enum class Sample : std::uint8_t { here, missing, lost };
  Tid next() const { return static_cast<Tid>(times_.size()); }
  Sample& sample(Tid tid) { return samples_[static_cast<std::size_t>(tid)]; }

  const Shape& shape_;
  const Tid depth_;
  std::mt19937_64& random_;
  const TestRing ring_;
  const SlotWriter slots_{*ring_.mapping};
  const RingReader reader_ = ring_.reader();
  std::vector<std::int64_t> times_;
  std::vector<Sample> samples_;
  Tid first_ = 0;
};

TEST(TimeSearch, OfAMirrorWithAHoleFindsTheRightSampleOrSaysThatItIsArriving) {
  const std::uint64_t seed = std::random_device{}();
  std::mt19937_64 random(seed);
  for (const Shape& shape : kShapes) {
    if (std::string_view(shape.name) == "extremes") continue;  // times next to them overflow here
    for (const std::uint64_t depth : {3, 5, 17, 100}) {
      SCOPED_TRACE(testing::Message() << shape.name << ", depth " << depth << ", seed " << seed);
      MirrorWithHole mirror(shape, depth, random);
      for (int i = 0; i < 400; ++i) {
        const std::int64_t what = below(random, 100);
        if (i == 0 || what < 40) {
          mirror.write(what < 10);
          mirror.lose_what_is_gone();
        } else if (what < 95) {
          mirror.send_passed_over();
        } else if (what < 97) {
          mirror.lose_some();
        } else {
          mirror.die_and_recover();
        }
        mirror.check();
        if (testing::Test::HasFatalFailure()) return;
      }
      while (!mirror.is_complete()) mirror.send_passed_over();
      mirror.check();
      if (testing::Test::HasFatalFailure()) return;
    }
  }
}

// A hole that is filled in many pieces, while newer samples come, and then times that run
// backwards: a search that walked from piece to piece would give up.
TEST(TimeSearch, TakesFewHopsThroughAHoleThatWasFilledInPieces) {
  constexpr Tid kHoleEnd = 20'000, kPiece = 3;
  const TestRing ring(1, 1 << 15);
  const SlotWriter slots(*ring.mapping);
  const RingReader reader = ring.reader();
  Tid newest = kHoleEnd;
  const auto publish = [&](Tid tid, std::int64_t time_ns) {
    slots.begin(tid);
    slots.publish({tid, time_from_ns(time_ns), {}, 1});
  };
  slots.skip_to(kHoleEnd, 0);
  publish(kHoleEnd, kHoleEnd * 10);
  for (Tid end = kHoleEnd; end > 0; end -= kPiece) {
    for (Tid tid = std::max<Tid>(end - kPiece, 0); tid < end; ++tid) {
      slots.begin(tid);
      slots.publish_in_hole({tid, time_from_ns(tid * 10), {}, 1});
    }
    slots.shrink_hole();
    ++newest;
    publish(newest, newest * 10);
  }
  ASSERT_TRUE(reader.hole().is_empty());
  const Tid last = newest;
  for (const Tid back : {last - 1, last / 2, Tid{100}}) {
    publish(++newest, back * 10 - 1);  // its parent is the sample before `back`
    for (const Tid wanted : {back - 1, back / 2, Tid{1}}) {
      Tid found = kNoTid;
      EXPECT_EQ(reader.find(time_from_ns(wanted * 10), found), ReadStatus::ok);
      EXPECT_EQ(found, wanted);
    }
  }
}

}  // namespace
}  // namespace dssm::ring
