// SPDX-License-Identifier: Apache-2.0
//
// Samples from a ring to a peer: each once and in order, gaps counted exactly, none that was
// overwritten while it was sent, wherever the socket stops.
#include "daemon/link/sample_pump.hpp"

#include <algorithm>
#include <map>
#include <random>
#include <set>

#include "tests/support/memory_peer.hpp"
#include "tests/support/sanitized.hpp"
#include "tests/unit/core/ring/test_ring.hpp"
#include "tests/unit/daemon/run_loop.hpp"

namespace dssm::daemon {
namespace {

using namespace test;
using namespace std::chrono_literals;

constexpr std::size_t kSmall = 40;
constexpr std::size_t kMiddle = SampleSender::kInPlaceBytes;
constexpr std::size_t kLarge = SampleSender::kMaxCopiedBytes + 1;
constexpr MonoTime kStart{std::chrono::seconds(1000)};

Time time_of(Tid tid) { return time_from_ns(1'000'000 + tid * 1000); }

// A ring, a link, and what goes from one to the other.
class PumpRig final : private FrameConnection::Observer, private SamplePump::Observer {
 public:
  PumpRig(std::size_t payload_bytes, std::uint64_t depth, bool may_tear = true,
          std::uint64_t budget_bytes = 1U << 30, TimerQueue::Time time = TimerQueue::Time::real)
      : loop(*EventLoop::open(time)),
        ring(payload_bytes, depth),
        payload_bytes_(payload_bytes),
        budget(budget_bytes),
        link(loop, std::make_unique<MemoryTransport>(peer), *this, 1U << 20),
        sender(*ring.mapping, link, {may_tear, &budget}) {}

  void start(const SamplePump::Plan& plan) {
    pump.emplace(*ring.mapping, link, sender, static_cast<SamplePump::Observer&>(*this), plan);
  }

  Tid write() {
    const Tid tid = ring.reader().newest() + 1;
    return ring.writer().write(payload_for(tid), time_of(tid), Duration(5));
  }
  std::vector<std::byte> payload_for(Tid tid) const {
    const std::size_t bytes[] = {payload_bytes_, 0, payload_bytes_ / 3, payload_bytes_ - 1};
    return ring::payload_for(tid, lengths_differ ? bytes[tid % 4] : payload_bytes_);
  }
  void write(int count) {
    for (int i = 0; i < count; ++i) write();
  }

  PumpWait run(MonoTime now = kStart) {
    const Result<PumpWait> wait = pump->pump(now);
    EXPECT_TRUE(wait) << wait.error().message;
    return wait ? *wait : PumpWait::ended;
  }
  // With as many turns of the loop as it takes. The rest of what is queued goes out, too.
  PumpWait run_on(MonoTime now = kStart) {
    PumpWait wait = run(now);
    for (int i = 0; i < 100'000 && (wait == PumpWait::output || wait == PumpWait::turn); ++i) {
      run_turns(loop);
      wait = run(now);
    }
    for (int i = 0; i < 100 && !link.output_empty(); ++i) run_turns(loop);
    return wait;
  }

  // What the peer accepts: each sample checked against what was written, in rising order, and
  // every tid between the first and the last either there or in a gap.
  std::vector<Tid> accepted() {
    std::vector<Tid> tids;
    Tid next = kNoTid;
    gaps.clear();
    for (const net::Frame& item : frames_of(peer.sent)) {
      if (item.has_gap()) {
        const Tid first = item.gap().first_tid();
        const auto count = static_cast<Tid>(item.gap().count());
        EXPECT_TRUE(next == kNoTid || newest_first || first == next) << "a gap begins elsewhere";
        gaps[first] = count;
        next = first + count;
      }
      if (!item.has_sample() || item.torn()) continue;
      const Tid tid = item.sample().tid();
      EXPECT_EQ(item.sample().time_ns(), to_ns(time_of(tid)));
      EXPECT_EQ(payload_of(item), payload_for(tid)) << "sample " << tid;
      EXPECT_TRUE(next == kNoTid || thinned || newest_first || tid == next)
          << tid << ", not " << next;
      next = tid + 1;
      tids.push_back(tid);
    }
    return tids;
  }
  std::size_t torn_seen() {
    std::size_t torn = 0;
    for (const net::Frame& item : frames_of(peer.sent)) torn += item.torn();
    return torn;
  }

  EventLoop loop;
  MemoryPeer peer;
  ring::TestRing ring;
  std::size_t payload_bytes_;
  MemoryBudget budget;
  FrameConnection link;
  SampleSender sender;
  std::optional<SamplePump> pump;
  std::map<Tid, Tid> gaps;
  bool thinned = false, newest_first = false, lengths_differ = false;
  int caught_up = 0, ends = 0;
  int written_when_caught_up = 0;  // by a writer that does not wait for the pump

 private:
  Result<void> on_frame(net::Frame&) override { return {}; }
  void on_closed(const Error& why) override { ADD_FAILURE() << why.message; }
  void on_gap(Tid first, std::uint64_t count) override {
    net::Frame frame;
    frame.mutable_gap()->set_first_tid(first);
    frame.mutable_gap()->set_count(count);
    link.send(frame);
  }
  void on_caught_up() override {
    ++caught_up;
    write(written_when_caught_up);
  }
  void on_end() override { ++ends; }
};

std::vector<Tid> tids(Tid first, Tid last) {
  std::vector<Tid> list;
  for (Tid tid = first; tid <= last; ++tid) list.push_back(tid);
  return list;
}

class SamplePumpOfEachKind : public testing::TestWithParam<std::size_t> {};
INSTANTIATE_TEST_SUITE_P(, SamplePumpOfEachKind, testing::Values(kSmall, kMiddle, kLarge),
                         [](const testing::TestParamInfo<std::size_t>& size) {
                           return size.param == kSmall    ? std::string("Small")
                                  : size.param == kMiddle ? std::string("Middle")
                                                          : std::string("Large");
                         });

TEST_P(SamplePumpOfEachKind, SendsAllThatIsThereAndWaitsForSamples) {
  PumpRig rig(GetParam(), 16);
  rig.write(10);
  rig.start({0, 9, 0});
  EXPECT_EQ(rig.run(), PumpWait::sample);
  EXPECT_EQ(rig.pump->known(), 9);
  EXPECT_EQ(rig.accepted(), tids(0, 9));
  EXPECT_EQ(rig.caught_up, 1);
  EXPECT_EQ(rig.run(), PumpWait::sample);
  rig.write(2);
  EXPECT_EQ(rig.run(), PumpWait::sample);
  EXPECT_EQ(rig.accepted(), tids(0, 11));
  EXPECT_EQ(rig.caught_up, 1);
  EXPECT_EQ(rig.pump->lost(), 0u);
}

TEST_P(SamplePumpOfEachKind, HasCaughtUpWithAnEmptyStreamAtOnce) {
  PumpRig rig(GetParam(), 16);
  rig.start({0, kNoTid, 0});
  EXPECT_EQ(rig.run(), PumpWait::sample);
  EXPECT_EQ(rig.caught_up, 1);
  rig.write();
  EXPECT_EQ(rig.run(), PumpWait::sample);
  EXPECT_EQ(rig.accepted(), tids(0, 0));
}

TEST_P(SamplePumpOfEachKind, ReportsExactlyWhatTheRingNoLongerHolds) {
  PumpRig rig(GetParam(), 8);
  rig.write(30);  // 23 to 29 are held
  rig.start({5, 29, 0});
  EXPECT_EQ(rig.run_on(), PumpWait::sample);
  EXPECT_EQ(rig.accepted(), tids(23, 29));
  EXPECT_EQ(rig.gaps, (std::map<Tid, Tid>{{5, 18}}));
  EXPECT_EQ(rig.pump->lost(), 18u);
  rig.write(20);
  EXPECT_EQ(rig.run_on(), PumpWait::sample);
  EXPECT_EQ(rig.gaps.size(), 1u);
  EXPECT_EQ(rig.accepted().back(), 49);
  EXPECT_EQ(rig.gaps, (std::map<Tid, Tid>{{5, 18}, {30, 13}}));
  EXPECT_EQ(rig.pump->lost(), 31u);
}

TEST_P(SamplePumpOfEachKind, WaitsForASampleOfTheFuture) {
  PumpRig rig(GetParam(), 16);
  rig.write(3);
  rig.start({5, 2, 0});
  EXPECT_EQ(rig.run(), PumpWait::sample);
  rig.write(2);
  EXPECT_EQ(rig.run(), PumpWait::sample);
  EXPECT_TRUE(rig.accepted().empty());
  rig.write(2);
  EXPECT_EQ(rig.run(), PumpWait::sample);
  EXPECT_EQ(rig.accepted(), tids(5, 6));
}

TEST_P(SamplePumpOfEachKind, EndsAfterTheLastOneWhereverThatIs) {
  PumpRig rig(GetParam(), 8);
  rig.write(10);
  rig.start({5, 9, 0});
  rig.pump->end_at(8);
  EXPECT_EQ(rig.run_on(), PumpWait::ended);
  EXPECT_EQ(rig.accepted(), tids(5, 8));
  EXPECT_EQ(rig.ends, 1);

  PumpRig lapped(GetParam(), 8);
  lapped.write(10);
  lapped.start({5, 9, 0});
  lapped.pump->end_at(6);
  lapped.write(20);
  EXPECT_EQ(lapped.run_on(), PumpWait::ended);
  EXPECT_TRUE(lapped.accepted().empty());
  EXPECT_EQ(lapped.gaps, (std::map<Tid, Tid>{{5, 2}})) << "not beyond the last one";
}

TEST_P(SamplePumpOfEachKind, DoesALimitedAmountInOneTurn) {
  PumpRig rig(GetParam(), 8192);
  const int count = GetParam() == kSmall ? 3000 : 200;
  rig.write(count);
  rig.start({0, count - 1, 0});
  EXPECT_EQ(rig.run(), PumpWait::turn);
  const std::size_t first_turn = rig.accepted().size();
  EXPECT_LE(first_turn, static_cast<std::size_t>(SamplePump::kSamplesPerTurn));
  EXPECT_LE(first_turn * GetParam(), SamplePump::kBytesPerTurn + kLarge);
  EXPECT_EQ(rig.run_on(), PumpWait::sample);
  EXPECT_EQ(rig.accepted(), tids(0, count - 1));
}

// Whoever has the ring writable can put anything there.
TEST_P(SamplePumpOfEachKind, TakesNonsenseInTheRingForNothing) {
  PumpRig rig(GetParam(), 8);
  rig.write(3);
  rig.start({0, 2, 0});
  rig.ring.mapping->header().top.store(INT64_MAX);
  EXPECT_EQ(rig.run(), PumpWait::sample);
  rig.ring.mapping->header().top.store(-5);
  EXPECT_EQ(rig.run(), PumpWait::sample);
  rig.ring.mapping->header().top.store(channel::kMaxTid);
  rig.run();  // whatever it says: no fault, and an end
  rig.ring.mapping->header().first.store(INT64_MAX);
  rig.run();
}

// The socket stops once, after each possible number of bytes.
TEST_P(SamplePumpOfEachKind, SendsWholeSamplesWhereverTheSocketStops) {
  const std::size_t payload_bytes = GetParam();
  for (const bool may_tear : {true, false}) {
    for (const std::uint64_t budget : {std::uint64_t{1} << 30, std::uint64_t{10}}) {
      if (!may_tear && budget == 10 && payload_bytes == kLarge) continue;  // cannot be sent at all
      std::size_t total = 0;
      {
        PumpRig rig(payload_bytes, 8, may_tear);
        rig.write(3);
        rig.start({0, 2, 0});
        rig.run_on();
        total = rig.peer.sent.size();
      }
      for (std::size_t room = 0; room <= total; ++room) {
        // All around the borders of frames, headers and torn trailers; samples of the rest.
        const std::size_t in_frame = room % (total / 3);
        if (in_frame > 45 && in_frame < total / 3 - 5 && room % (total / 16) != 0) continue;
        PumpRig rig(payload_bytes, 8, may_tear, budget);
        rig.lengths_differ = room % 2 == 1;
        rig.write(3);
        rig.start({0, 2, 0});
        rig.peer.room = room;
        rig.run();
        rig.peer.room = MemoryPeer::kAll;
        EXPECT_EQ(rig.run_on(), PumpWait::sample);
        ASSERT_EQ(rig.accepted(), tids(0, 2)) << "room for " << room << " of " << total;
        EXPECT_EQ(rig.torn_seen(), 0u);
        EXPECT_EQ(rig.budget.used(), 0u);
      }
    }
  }
}

TEST_P(SamplePumpOfEachKind, SendsAllWhenTheSocketTakesLittleAtATime) {
  const auto seed = std::random_device()();
  SCOPED_TRACE("seed " + std::to_string(seed));
  std::mt19937 random(seed);
  const int rounds = GetParam() == kSmall ? 20 : 8;
  for (int round = 0; round < rounds; ++round) {
    PumpRig rig(GetParam(), 64, round % 2 == 0, round % 4 < 2 ? 1U << 30 : GetParam() + 200);
    rig.lengths_differ = round % 3 > 0;
    rig.write(40);
    rig.start({0, 39, 0});
    rig.peer.room = 0;
    rig.peer.max_send_bytes = 1 + random() % (GetParam() * 2);
    PumpWait wait = rig.run();
    while (wait != PumpWait::sample) {
      rig.peer.room = random() % 3 == 0 ? 0 : random() % (GetParam() * 3);
      run_turns(rig.loop);
      wait = rig.run();
    }
    rig.peer.room = MemoryPeer::kAll;
    rig.run_on();
    EXPECT_EQ(rig.accepted(), tids(0, 39));
    EXPECT_EQ(rig.torn_seen(), 0u);
  }
}

// A writer that is faster than the peer, and writes between any two sends.
TEST_P(SamplePumpOfEachKind, LosesNothingWithoutSayingSoWhenItIsLapped) {
  const auto seed = std::random_device()();
  SCOPED_TRACE("seed " + std::to_string(seed));
  std::mt19937 random(seed);
  const int rounds = GetParam() == kSmall ? 30 : 6;
  for (int round = 0; round < rounds; ++round) {
    PumpRig rig(GetParam(), 4 + random() % 8, round % 3 != 0,
                round % 2 == 0 ? 1U << 30 : GetParam() + 200);
    rig.lengths_differ = round % 4 > 1;
    rig.write(2);
    rig.start({0, 1, 0});
    rig.peer.max_send_bytes = 1 + random() % (2 * GetParam());
    rig.peer.after_send = [&] {
      if (random() % 2) rig.write(static_cast<int>(random() % 5));
    };
    for (int turn = 0; turn < (GetParam() == kLarge ? 60 : 200); ++turn) {
      rig.peer.room = random() % 3 == 0 ? 0 : random() % (2 * GetParam());
      run_turns(rig.loop);
      rig.run();
    }
    rig.peer.after_send = nullptr;
    rig.peer.room = MemoryPeer::kAll;
    EXPECT_EQ(rig.run_on(), PumpWait::sample);
    const std::vector<Tid> got = rig.accepted();  // checks bytes, order and gaps
    ASSERT_FALSE(got.empty());
    EXPECT_EQ(got.back(), rig.ring.reader().newest());
    std::uint64_t lost = 0;
    for (const auto& [first, count] : rig.gaps) lost += static_cast<std::uint64_t>(count);
    EXPECT_EQ(lost, rig.pump->lost());
    EXPECT_EQ(got.size() + lost, static_cast<std::uint64_t>(rig.ring.reader().newest()) + 1);
    EXPECT_EQ(rig.torn_seen(), rig.sender.counters().torn);
    EXPECT_EQ(rig.budget.used(), 0u);
  }
}

// --- large payloads

// Overwrites the slot of the sample that is being sent, once.
void overwrite_in(PumpRig& rig) {
  rig.peer.after_send = [&rig] {
    rig.peer.after_send = nullptr;
    rig.write(8);
  };
}

TEST(SamplePump, MarksALargeSampleThatIsOverwrittenWhileItIsSent) {
  PumpRig rig(kLarge, 4);
  rig.write(1);
  rig.start({0, 0, 0});
  overwrite_in(rig);
  EXPECT_EQ(rig.run_on(), PumpWait::sample);
  EXPECT_EQ(rig.torn_seen(), 1u);
  EXPECT_EQ(rig.accepted(), tids(6, 8));
  EXPECT_EQ(rig.gaps, (std::map<Tid, Tid>{{0, 6}})) << "the void sample counts as lost";
}

TEST(SamplePump, KeepsWhatItCopiedAsideWhenTheSlotIsOverwrittenLater) {
  PumpRig rig(kLarge, 4);
  rig.write(1);
  rig.start({0, 0, 0});
  rig.peer.room = 100;  // header and some of the payload: the rest is copied at once
  EXPECT_EQ(rig.run(), PumpWait::output);
  EXPECT_GT(rig.budget.used(), kLarge - 100);
  rig.write(8);
  rig.peer.room = MemoryPeer::kAll;
  EXPECT_EQ(rig.run_on(), PumpWait::sample);
  EXPECT_EQ(rig.torn_seen(), 0u);
  EXPECT_EQ(rig.accepted().front(), 0);
  EXPECT_EQ(rig.gaps, (std::map<Tid, Tid>{{1, 5}}));
}

TEST(SamplePump, RisksTheSlotWhenThePeersMemoryIsUsedUp) {
  PumpRig rig(kLarge, 4, true, 1000);
  rig.write(1);
  rig.start({0, 0, 0});
  rig.peer.room = 100;
  EXPECT_EQ(rig.run(), PumpWait::output);
  EXPECT_TRUE(rig.sender.busy());
  EXPECT_EQ(rig.budget.used(), 0u);
  rig.write(8);
  rig.peer.room = MemoryPeer::kAll;
  EXPECT_EQ(rig.run_on(), PumpWait::sample);
  EXPECT_EQ(rig.torn_seen(), 1u);
  EXPECT_EQ(rig.accepted(), tids(6, 8));
}

TEST(SamplePump, NeverSendsAVoidSampleToAPeerThatDoesNotKnowThem) {
  PumpRig rig(kLarge, 4, false);
  rig.write(1);
  rig.start({0, 0, 0});
  overwrite_in(rig);
  EXPECT_EQ(rig.run_on(), PumpWait::sample);
  EXPECT_EQ(rig.torn_seen(), 0u);
  EXPECT_EQ(rig.accepted().back(), 8);
}

TEST(SamplePump, FailsWhenItMayNeitherTearNorCopy) {
  PumpRig rig(kLarge, 4, false, 1000);
  rig.write(1);
  rig.start({0, 0, 0});
  const Result<PumpWait> wait = rig.pump->pump(kStart);
  ASSERT_FALSE(wait);
  EXPECT_EQ(wait.error().code, Errc::limit_exceeded);
  EXPECT_NE(wait.error().message.find("max_peer_memory"), std::string::npos);
}

TEST(SamplePump, CountsTheLengthThatShortSamplesOfALongTypeHave) {
  PumpRig rig(SamplePump::kBytesPerTurn, 64);
  for (int i = 0; i < 50; ++i) {
    rig.ring.writer().write(ring::payload_for(i, 100), time_of(i), Duration(5));
  }
  rig.start({0, 49, 0});
  EXPECT_EQ(rig.run(), PumpWait::sample) << "all in one turn";
  EXPECT_EQ(rig.sender.counters().samples, 50u);
}

TEST(SamplePump, CutsALongSampleIntoTurns) {
  constexpr std::size_t kLong = 5 * SamplePump::kBytesPerTurn + 17;
  for (const bool may_tear : {true, false}) {
    PumpRig rig(kLong, 4, may_tear);
    rig.write(2);
    rig.start({0, 1, 0});
    EXPECT_EQ(rig.run(), PumpWait::turn);
    EXPECT_LE(rig.peer.sent.size(), SamplePump::kBytesPerTurn + 100);
    if (may_tear) {
      EXPECT_EQ(rig.peer.sends, SamplePump::kBytesPerTurn / SampleSender::kSliceBytes);
    }
    EXPECT_EQ(rig.run_on(), PumpWait::sample);
    EXPECT_EQ(rig.accepted(), tids(0, 1));
  }
}

TEST(SamplePump, ChecksAgainAfterALongSampleIsCopiedAside) {
  constexpr std::size_t kLong = 3 * SamplePump::kBytesPerTurn;
  for (const bool may_tear : {true, false}) {
    PumpRig rig(kLong, 4, may_tear);
    rig.write(1);
    rig.start({0, 0, 0});
    rig.peer.room = 100;
    EXPECT_EQ(rig.run(), PumpWait::turn) << "a part is copied";
    rig.write(8);
    rig.peer.room = MemoryPeer::kAll;
    EXPECT_EQ(rig.run_on(), PumpWait::sample);
    EXPECT_EQ(rig.torn_seen(), may_tear ? 1u : 0u);
    EXPECT_EQ(rig.accepted(), tids(6, 8));
    EXPECT_EQ(rig.gaps, (std::map<Tid, Tid>{{0, 6}}));
  }
}

TEST(SamplePump, CopiesNothingWhenTheSocketTakesAllOfALargeSample) {
  PumpRig large(kLarge, 8), small(kSmall, 8);
  for (PumpRig* rig : {&large, &small}) {
    rig->write(5);
    rig->start({0, 4, 0});
    rig->run_on();
    EXPECT_EQ(rig->sender.counters().samples, 5u);
  }
  EXPECT_EQ(large.sender.counters().copied_payload_bytes, 0u);
  EXPECT_EQ(large.sender.counters().in_place_payload_bytes, 5 * kLarge);
  EXPECT_EQ(small.sender.counters().copied_payload_bytes, 5 * kSmall);
  EXPECT_EQ(small.peer.sends, 1u) << "all small samples in one send";
  EXPECT_EQ(large.peer.sends, 6u) << "one send each, and one for the last torn trailer";
}

TEST(SamplePump, CopiesOneThatIsNotLargeAndComesAlone) {
  PumpRig rig(kMiddle, 8);
  rig.start({0, kNoTid, 0});
  for (int i = 0; i < 3; ++i) {
    rig.write();
    EXPECT_EQ(rig.run(), PumpWait::sample);
  }
  EXPECT_EQ(rig.sender.counters().copied_payload_bytes, 3 * kMiddle);
  EXPECT_EQ(rig.peer.sends, 3u) << "one send each";
  rig.write(3);
  rig.run_on();
  EXPECT_EQ(rig.sender.counters().in_place_payload_bytes, 2 * kMiddle);
  EXPECT_EQ(rig.peer.sends, 6u) << "the last of a run brings the torn trailer of the one before";
  EXPECT_EQ(rig.accepted(), tids(0, 5));
}

TEST(SamplePump, StopsAfterTheSampleUnderWayWhenAnotherFrameIsToBeSent) {
  PumpRig rig(kLarge, 8, true, 1000);
  rig.write(3);
  rig.start({0, 2, 0});
  rig.peer.room = 500;
  EXPECT_EQ(rig.run(), PumpWait::output);
  EXPECT_TRUE(rig.sender.busy());
  rig.peer.room = MemoryPeer::kAll;
  const Result<PumpWait> wait = rig.pump->pump(kStart, true);
  ASSERT_TRUE(wait);
  EXPECT_EQ(*wait, PumpWait::turn);
  EXPECT_FALSE(rig.sender.busy());
  EXPECT_EQ(rig.accepted(), tids(0, 0)) << "whole, with its torn trailer";
}

// --- thinning

TEST(SamplePump, SendsTheNewestAtEachTimeWhenItThins) {
  PumpRig rig(kSmall, 64);
  rig.thinned = true;
  rig.write(10);
  rig.start({0, 9, 100});
  EXPECT_EQ(rig.run(kStart), PumpWait::sample);
  EXPECT_EQ(rig.accepted(), tids(9, 9));
  EXPECT_EQ(rig.caught_up, 1);
  const auto at = [](int ms) { return kStart + std::chrono::milliseconds(ms); };
  for (int ms = 1; ms <= 100; ++ms) {  // a sample per millisecond
    rig.write();
    const bool waits = rig.run(at(ms)) == PumpWait::time;
    EXPECT_EQ(waits, ms % 10 != 0) << ms;
    EXPECT_EQ(waits, waits && rig.pump->due() > at(ms)) << ms;
  }
  const std::vector<Tid> got = rig.accepted();
  EXPECT_EQ(got.size(), 11u) << "one at once, then 10 in 100 ms";
  for (std::size_t i = 1; i < got.size(); ++i) EXPECT_EQ(got[i], 9 + static_cast<Tid>(i) * 10);
  EXPECT_EQ(rig.pump->lost(), 0u) << "what is left out is no loss";
  EXPECT_TRUE(rig.gaps.empty());
}

TEST(SamplePump, SendsOneSampleAtATimeThoughTheWriterContinues) {
  PumpRig rig(kSmall, 64);
  rig.thinned = true;
  rig.write(10);
  rig.written_when_caught_up = 5;
  rig.start({0, kNoTid, 100});
  EXPECT_EQ(rig.run(kStart), PumpWait::time);
  EXPECT_EQ(rig.accepted(), tids(9, 9));
}

TEST(SamplePump, SendsEachSampleOfAStreamThatIsSlowerThanTheHighestRate) {
  PumpRig rig(kSmall, 64);
  rig.start({0, kNoTid, 100});
  for (int ms = 0; ms < 500; ms += 50) {
    rig.write();
    EXPECT_EQ(rig.run(kStart + std::chrono::milliseconds(ms)), PumpWait::sample);
  }
  EXPECT_EQ(rig.accepted(), tids(0, 9));
}

// As many as the network carries.
TEST(SamplePump, SendsTheNewestEachTimeTheNetworkTakesOneWithAVeryHighRate) {
  PumpRig rig(kLarge, 64);
  rig.thinned = true;
  rig.write(10);
  rig.start({0, 9, 1e6});
  EXPECT_EQ(rig.run_on(kStart), PumpWait::sample);
  rig.peer.room = kLarge / 2;
  rig.write();
  EXPECT_EQ(rig.run(kStart + 10ms), PumpWait::output);
  rig.write(5);
  rig.peer.room = MemoryPeer::kAll;
  EXPECT_EQ(rig.run_on(kStart + 30ms), PumpWait::sample);
  EXPECT_EQ(rig.accepted(), (std::vector<Tid>{9, 10, 15}));
  EXPECT_EQ(rig.pump->lost(), 0u);
}

TEST(SamplePump, ReportsNoGapWhenAThinnedStreamLapsIt) {
  PumpRig rig(kLarge, 4);
  rig.thinned = true;
  rig.write(20);
  rig.start({0, 19, 1});
  overwrite_in(rig);
  EXPECT_EQ(rig.run_on(kStart), PumpWait::sample);
  EXPECT_EQ(rig.torn_seen(), 1u);
  EXPECT_EQ(rig.accepted().back(), 27);
  EXPECT_TRUE(rig.gaps.empty());
}

// A program with write access can make `top` name a slot that holds nothing.
TEST(SamplePump, WaitsAlsoWhenTheNewestSampleIsNone) {
  for (const bool newest_first : {false, true}) {
    for (const double rate_hz : {0.0, 50.0}) {
      SCOPED_TRACE(testing::Message() << "newest first " << newest_first << ", rate " << rate_hz);
      PumpRig rig(kSmall, 8);
      rig.newest_first = newest_first;
      rig.write(3);
      SamplePump::Plan plan{0, 2, rate_hz};
      plan.newest_first = newest_first;
      rig.start(plan);
      EXPECT_EQ(rig.run_on(kStart), PumpWait::sample);
      rig.ring.mapping->header().top = 5;
      EXPECT_EQ(rig.run_on(kStart + 1s), PumpWait::sample);
    }
  }
}

// --- the newest first

class NewestFirst : public testing::Test {
 protected:
  void start(SamplePump::Plan plan) {
    rig.newest_first = plan.newest_first = true;
    rig.start(plan);
  }

  explicit NewestFirst(std::uint64_t depth = 16) : rig{kLarge, depth} {}

  PumpRig rig;
};

TEST_F(NewestFirst, ThoseBeforeItFollowTheNewestOfThemFirst) {
  rig.write(6);
  start({1, 5, 0});
  EXPECT_EQ(rig.run_on(), PumpWait::sample);
  EXPECT_EQ(rig.accepted(), (std::vector<Tid>{5, 4, 3, 2, 1}));
  EXPECT_EQ(rig.caught_up, 1);
  rig.write();
  EXPECT_EQ(rig.run_on(), PumpWait::sample);
  EXPECT_EQ(rig.accepted().back(), 6);
  EXPECT_EQ(rig.pump->known(), 6);
}

TEST_F(NewestFirst, OneThatIsWrittenMeanwhileComesBeforeWhatIsOld) {
  rig.peer.room = kLarge;
  rig.write(4);
  start({0, 3, 0});
  EXPECT_EQ(rig.run(), PumpWait::output);
  rig.write(2);
  rig.peer.room = MemoryPeer::kAll;
  EXPECT_EQ(rig.run_on(), PumpWait::sample);
  EXPECT_EQ(rig.accepted(), (std::vector<Tid>{3, 5, 4, 2, 1, 0}));
}

TEST_F(NewestFirst, WhatTheReceiverHasIsNotSent) {
  rig.write(10);
  SamplePump::Plan plan{2, 9, 0};
  plan.held = {4, 8};
  start(plan);
  EXPECT_EQ(rig.run_on(), PumpWait::sample);
  EXPECT_EQ(rig.accepted(), (std::vector<Tid>{9, 8, 3, 2}));
}

TEST_F(NewestFirst, WhatTheReceiverClaimsToHaveMayBeNonsense) {
  rig.write(3);
  for (const ring::TidRange held :
       {ring::TidRange{-5, -2}, {2, 1}, {5, 7}, {0, channel::kMaxTid}, {INT64_MIN + 1, 2}}) {
    SamplePump::Plan plan{0, 2, 0};
    plan.held = held;
    start(plan);
    EXPECT_EQ(rig.run_on(), PumpWait::sample);
    EXPECT_EQ(rig.pump->known(), 2);
  }
}

TEST_F(NewestFirst, WhatTheRingNoLongerHoldsIsReportedOldestFirst) {
  rig.peer.room = kLarge;
  rig.write(10);
  start({0, 9, 0});
  EXPECT_EQ(rig.run(), PumpWait::output);
  rig.write(10);  // the ring holds 5 to 19 now
  rig.peer.room = MemoryPeer::kAll;
  EXPECT_EQ(rig.run_on(), PumpWait::sample);
  const std::vector<Tid> accepted = rig.accepted();
  EXPECT_EQ(accepted.front(), 9);
  EXPECT_EQ(accepted[1], 19);
  EXPECT_EQ(accepted.back(), 5);
  EXPECT_EQ(accepted.size(), 15u);
  EXPECT_EQ(rig.gaps, (std::map<Tid, Tid>{{0, 5}}));
}

// Three samples are written in each second, and the network carries one.
class Overloaded : public NewestFirst {
 protected:
  explicit Overloaded(std::uint64_t depth = 16) : NewestFirst(depth) {
    start({0, kNoTid, 0});
    rig.write();
    EXPECT_EQ(rig.run_on(), PumpWait::sample);
    frame_bytes_ = rig.peer.sent.size();
    rig.write();
    rig.peer.room = frame_bytes_ / 2;
    EXPECT_EQ(rig.run(), PumpWait::output);
  }
  void round(int count) {
    rig.write(3);  // while one is sent
    rig.peer.room = frame_bytes_;
    run_turns(rig.loop);  // the rest of the one before
    EXPECT_EQ(rig.run(kStart + count * SamplePump::kOverloadedAfter / 3), PumpWait::output);
  }

 private:
  std::size_t frame_bytes_ = 0;
};

TEST_F(Overloaded, WhatTheNetworkNeverCarriesIsLostAtOnce) {
  for (int i = 1; i < 4; ++i) round(i);
  EXPECT_EQ(rig.pump->lost(), 0u) << "it may be a pause";
  round(4);
  EXPECT_EQ(rig.pump->lost(), 8u);
  round(5);
  EXPECT_EQ(rig.pump->lost(), 10u);
  rig.peer.room = MemoryPeer::kAll;
  EXPECT_EQ(rig.run_on(), PumpWait::sample);
  EXPECT_EQ(rig.accepted(), (std::vector<Tid>{0, 1, 4, 7, 10, 13, 16}));
  EXPECT_EQ(rig.gaps, (std::map<Tid, Tid>{{2, 2}, {5, 2}, {8, 2}, {11, 2}, {14, 2}}));
}

class OverloadedWithALongHistory : public Overloaded {
 protected:
  OverloadedWithALongHistory() : Overloaded(64) {}
};

TEST_F(OverloadedWithALongHistory, NothingIsGivenUpThatTheRingHoldsForFiveSeconds) {
  int rounds = 0;
  while (rig.pump->lost() == 0 && rounds < 30) round(++rounds);
  // Sample 2 was passed over first: 49 later it has 15 to go, those of five seconds. It is counted
  // every third round.
  EXPECT_EQ(rounds, 19);
  EXPECT_EQ(rig.ring.reader().oldest(), 0) << "nothing was overwritten";
  const std::uint64_t lost = rig.pump->lost();
  round(++rounds);
  EXPECT_EQ(rig.pump->lost(), lost + 2) << "from then on at once";
}

class OverloadedWithAVeryLongHistory : public Overloaded {
 protected:
  OverloadedWithAVeryLongHistory() : Overloaded(256) {}
};

TEST_F(OverloadedWithAVeryLongHistory, NothingIsSparedForEver) {
  int rounds = 0;
  while (rig.pump->lost() == 0 && rounds < 60) round(++rounds);
  EXPECT_EQ(rounds, 31);
}

// Of 200 samples a second, on a network that is never faster nor slower.
class Thinning : public testing::TestWithParam<int> {};
INSTANTIATE_TEST_SUITE_P(CarriedPerSecond, Thinning, testing::Values(38, 90, 150, 190),
                         testing::PrintToStringParamName());

TEST_P(Thinning, IsEven) {
  constexpr int kPeriodMs = 5, kAfterwardsMs = 2000, kMostMs = 60'000;
  PumpRig rig(kLarge, 16);
  rig.newest_first = true;
  SamplePump::Plan plan{0, kNoTid, 0};
  plan.newest_first = true;
  rig.start(plan);
  rig.write();
  EXPECT_EQ(rig.run_on(), PumpWait::sample);
  const std::size_t bytes_per_ms =
      rig.peer.sent.size() * static_cast<std::size_t>(GetParam()) / 1000;
  rig.peer.room = 0;
  int known_at = kMostMs;
  std::size_t sent_before = 0;
  for (int ms = 1; ms < known_at + kAfterwardsMs; ++ms) {
    if (ms % kPeriodMs == 0) rig.write();
    rig.peer.room = std::min(rig.peer.room + bytes_per_ms, 2 * bytes_per_ms);
    run_turns(rig.loop);  // the rest of the one before
    rig.run(kStart + std::chrono::milliseconds(ms));
    if (known_at < kMostMs || rig.pump->lost() == 0) continue;
    known_at = ms;
    sent_before = rig.peer.sent.size();
  }
  ASSERT_LT(known_at, kMostMs) << "nothing was left out";
  rig.peer.room = MemoryPeer::kAll;
  run_turns(rig.loop);
  EXPECT_TRUE(rig.pump->pump(kStart, true)) << "the rest of the last one";
  run_turns(rig.loop);
  const std::vector<Tid> all = rig.accepted();
  const auto before = static_cast<std::ptrdiff_t>(all.size() * sent_before / rig.peer.sent.size());
  Tid longest = 0;
  for (auto tid = all.begin() + before + 2; tid + 1 < all.end(); ++tid) {
    longest = std::max(longest, tid[1] - tid[0] - 1);
  }
  const double mean = 200.0 / GetParam() - 1;
  EXPECT_LE(static_cast<double>(longest), 2 * mean + 1) << "left out in a row";
  EXPECT_TRUE(std::is_sorted(all.begin() + before + 2, all.end())) << "nothing old comes later";
}

TEST_F(NewestFirst, WhatWaitedForAPauseOfTheNetworkIsSentLater) {
  start({0, kNoTid, 0});
  rig.write();
  EXPECT_EQ(rig.run_on(), PumpWait::sample);
  rig.write();
  rig.peer.room = 100;
  EXPECT_EQ(rig.run(), PumpWait::output);
  rig.write(10);
  rig.peer.room = MemoryPeer::kAll;
  EXPECT_EQ(rig.run_on(kStart + 10 * SamplePump::kOverloadedAfter), PumpWait::sample);
  EXPECT_EQ(rig.accepted().size(), 12u);
  EXPECT_TRUE(rig.gaps.empty());
}

TEST_F(NewestFirst, AFastNetworkGetsAllInTheirOrder) {
  rig.peer.progress.emplace().carried_bytes_per_s = 1'000'000'000;  // 4 MB in 4 ms
  rig.write(6);
  start({0, 5, 0});
  EXPECT_EQ(rig.run_on(), PumpWait::sample);
  EXPECT_EQ(rig.accepted(), tids(0, 5));
}

TEST_F(NewestFirst, LittleWaitsInTheKernelOfASlowNetwork) {
  rig.peer.progress.emplace().carried_bytes_per_s = 10'000'000;
  rig.write(6);
  start({0, 5, 0});
  EXPECT_EQ(rig.peer.unsent_limit, SamplePump::kMinUnsentBytes) << "until more is known";
  rig.peer.room = kLarge / 2;
  EXPECT_EQ(rig.run(), PumpWait::output);
  EXPECT_EQ(rig.peer.unsent_limit, 20'000u);
  rig.peer.progress->carried_bytes_per_s = 1'000'000'000;
  rig.peer.progress->waiting_bytes = 1;
  rig.peer.room = 1000;
  run_turns(rig.loop);
  EXPECT_EQ(rig.run(), PumpWait::output);
  EXPECT_EQ(rig.peer.unsent_limit, SamplePump::kUnsentBytes);
  rig.start({0, 5, 0});
  EXPECT_EQ(rig.peer.unsent_limit, 0u) << "for samples in their order the system's is best";
}

// Their acknowledgements may come late.
TEST(SamplePump, SendsMoreSmallSamplesAtOnceWhenAllWereSentBeforeItRanAgain) {
  PumpRig rig(kSmall, 4096);
  rig.newest_first = true;
  rig.peer.progress.emplace().waiting_bytes = 1'000'000;
  rig.write(4000);
  SamplePump::Plan plan{0, 3999, 0};
  plan.newest_first = true;
  rig.start(plan);
  rig.peer.room = 100;
  EXPECT_EQ(rig.run(), PumpWait::output);
  const auto after = [&](std::size_t unsent_bytes) {
    rig.peer.progress->unsent_bytes = unsent_bytes;
    rig.peer.room = 100;
    run_turns(rig.loop);
    EXPECT_EQ(rig.run(), PumpWait::output);
    return rig.peer.unsent_limit;
  };
  EXPECT_EQ(after(0), 2 * SamplePump::kUnsentBytes);
  EXPECT_EQ(after(0), 4 * SamplePump::kUnsentBytes);
  EXPECT_EQ(after(SamplePump::kUnsentBytes), 4 * SamplePump::kUnsentBytes);
  EXPECT_LT(after(2 * SamplePump::kUnsentBytes), 4 * SamplePump::kUnsentBytes);
}

TEST(SamplePump, KeepsLittleInTheKernelAlsoWithARate) {
  PumpRig rig(kLarge, 16);
  rig.thinned = true;
  rig.peer.progress.emplace().carried_bytes_per_s = 10'000'000;
  rig.write(2);
  rig.peer.room = 1000;
  rig.peer.progress->waiting_bytes = 1;
  rig.start({0, 1, 1000});
  EXPECT_EQ(rig.peer.unsent_limit, SamplePump::kMinUnsentBytes);
  EXPECT_EQ(rig.run(), PumpWait::output);
  rig.peer.room = 1000;
  run_turns(rig.loop);
  EXPECT_EQ(rig.run(), PumpWait::output);
  EXPECT_EQ(rig.peer.unsent_limit, 20'000u);
}

// dssmd was late, and the network had nothing to carry meanwhile.
TEST_F(NewestFirst, WhatWaitsInTheKernelLastsUntilDssmdRunsAgain) {
  rig.peer.progress.emplace().carried_bytes_per_s = 10'000'000;
  rig.write(6);
  start({0, 5, 0});
  rig.peer.room = 1000;
  EXPECT_EQ(rig.run(), PumpWait::output);
  rig.peer.after_send = [&] { rig.peer.progress->waiting_bytes = 1'000'000; };
  const auto after = [&](std::size_t waiting_bytes) {
    rig.peer.progress->waiting_bytes = waiting_bytes;
    rig.peer.room = 1000;
    run_turns(rig.loop);  // the rest of what was queued
    EXPECT_EQ(rig.run(), PumpWait::output);
    return rig.peer.unsent_limit;
  };
  EXPECT_EQ(after(5000), 20'000u);
  EXPECT_EQ(after(0), 40'000u);
  EXPECT_EQ(after(0), 80'000u);
  EXPECT_EQ(after(20'000), 80'000u);
  EXPECT_EQ(after(20'001), 70'000u);
  for (int i = 0; i < 20; ++i) after(20'000);
  EXPECT_EQ(after(20'000), 20'000u);
  for (int i = 0; i < 20; ++i) after(0);
  EXPECT_EQ(after(0), SamplePump::kMostUnsentBytes);
}

TEST_F(NewestFirst, TheEndOfAStreamComesAfterAllOfIt) {
  rig.write(5);
  start({0, 4, 0});
  rig.pump->end_at(4);
  EXPECT_EQ(rig.run_on(), PumpWait::ended);
  EXPECT_EQ(rig.accepted().size(), 5u);
  EXPECT_EQ(rig.ends, 1);
}

// Three samples of 328 KB, and a network that was found to carry 1 MB/s.
class PacedHistory : public testing::Test {
 public:
  PacedHistory() {
    rig.newest_first = true;
    rig.write(3);
    rig.link.set_pace(pace);
    rig.peer.progress.emplace().packet_bytes = 1000;
    MemoryTransport transport(rig.peer);
    for (int ms = 0; ms <= 205; ms += 5) {
      rig.peer.progress->delivered_packets = static_cast<std::uint32_t>(ms);
      rig.peer.progress->sending = ms * 1ms;
      pace.allowance(rig.loop.now() + (ms - 205) * 1ms, {this, 0, transport});
      pace.on_full(this);
    }
    SamplePump::Plan plan{0, 2, 0};
    plan.newest_first = true;
    rig.start(plan);
  }
  void pass(Duration time) {
    bool is_over = false;
    EventSource timer = EventSource::timer(rig.loop, [&] { is_over = true; });
    timer.enable_in(time);
    run_until(rig.loop, [&] { return is_over; });
  }

  // A sample of the history is sent in part.
  void run_until_under_way() {
    EXPECT_EQ(rig.run_on(), PumpWait::pace);
    do {
      pass(rig.pump->due() - rig.loop.now());
      ASSERT_EQ(rig.run_on(), PumpWait::pace);
    } while (!rig.sender.busy());
  }

  HistoryPace pace;
  PumpRig rig{5 * kLarge, 8, true, 1U << 30, TimerQueue::Time::simulated};
};

TEST_F(PacedHistory, FollowsTheNewestSampleInPieces) {
  EXPECT_EQ(rig.run_on(), PumpWait::pace);
  EXPECT_EQ(rig.accepted(), (std::vector<Tid>{2})) << "at once";
  EXPECT_GT(rig.pump->due(), rig.loop.now());
  const std::size_t before = rig.peer.sent.size();
  for (int i = 0; i < 100; ++i) {
    pass(rig.pump->due() - rig.loop.now());
    ASSERT_EQ(rig.run_on(), PumpWait::pace);
  }
  EXPECT_GT(rig.peer.sent.size() - before, 100 * HistoryPace::kMinPieceBytes / 2);
  rig.write();
  EXPECT_EQ(rig.run_on(), PumpWait::sample);
  EXPECT_EQ(rig.accepted(), (std::vector<Tid>{2, 1, 0, 3}));
}

TEST_F(PacedHistory, TakesNoMoreThanItsShare) {
  const auto bytes_in = [&](Duration time) {
    const std::size_t before = rig.peer.sent.size();
    const MonoTime end = rig.loop.now() + time;
    while (rig.loop.now() < end && rig.run_on() == PumpWait::pace) {
      pass(std::max<Duration>(rig.pump->due() - rig.loop.now(), 1ms));
    }
    return static_cast<double>(rig.peer.sent.size() - before);
  };
  bytes_in(100ms);  // the newest one
  EXPECT_NEAR(bytes_in(250ms), 0.25 * HistoryPace::kShare * 1e6, 0.02e6);
  rig.link.set_history_share(0.2);
  EXPECT_NEAR(bytes_in(1s), 0.2 * 1e6, 0.03e6);
}

TEST_F(PacedHistory, LetsNewSamplesPassAtOnce) {
  ASSERT_NO_FATAL_FAILURE(run_until_under_way());
  rig.write();
  EXPECT_EQ(rig.run_on(), PumpWait::pace);
  EXPECT_EQ(rig.accepted(), (std::vector<Tid>{2, 1, 3})) << "also what was under way";
}

TEST_F(PacedHistory, LetsAnotherUserOfTheConnectionSend) {
  ASSERT_NO_FATAL_FAILURE(run_until_under_way());
  rig.peer.room = 100;  // the rest is copied aside
  for (int turns = 0; turns < 3 && rig.sender.busy(); ++turns) {
    EXPECT_TRUE(rig.pump->pump(kStart, true));
  }
  EXPECT_FALSE(rig.sender.busy());
  EXPECT_EQ(*rig.pump->pump(kStart, true), PumpWait::output) << "not another turn";
  rig.peer.room = MemoryPeer::kAll;
  while (!rig.link.output_empty()) run_turns(rig.loop);
  EXPECT_EQ(*rig.pump->pump(kStart, true), PumpWait::turn);
}

TEST_F(PacedHistory, WaitsOnlyForItsTimeWhenTheStreamWasRemoved) {
  EXPECT_EQ(rig.run_on(), PumpWait::pace);
  rig.pump->end_at(2);
  rig.write();  // its writer goes on
  EXPECT_EQ(rig.run_on(), PumpWait::time);
  EXPECT_GT(rig.pump->due(), rig.loop.now());
}

TEST_F(PacedHistory, WaitsInItsSlotForTheSocket) {
  EXPECT_EQ(rig.run_on(), PumpWait::pace);
  pass(1s);
  rig.peer.room = 100;
  EXPECT_EQ(rig.run(), PumpWait::output);
  EXPECT_TRUE(rig.link.output_empty()) << "a copy would be sent at once";
  rig.peer.room = MemoryPeer::kAll;
  rig.write();
  EXPECT_EQ(rig.run_on(), PumpWait::pace);
  EXPECT_EQ(rig.accepted(), (std::vector<Tid>{2, 1, 3}));
}

// --- with a rate, too

class NewestFirstWithARate : public NewestFirst {
 protected:
  void start_at(double rate_hz, Tid first, Tid newest, ring::TidRange held = {}) {
    SamplePump::Plan plan{first, newest, rate_hz};
    plan.held = held;
    start(plan);
  }
};

TEST_F(NewestFirstWithARate, WhatIsLeftOutIsLostAndHistoryIsNot) {
  rig.write(4);
  start_at(10, 0, 3);
  EXPECT_EQ(rig.run_on(), PumpWait::sample);
  EXPECT_EQ(rig.accepted(), (std::vector<Tid>{3, 2, 1, 0}));
  rig.write(3);
  EXPECT_EQ(rig.run_on(kStart + 99ms), PumpWait::time);
  EXPECT_EQ(rig.pump->due(), kStart + 100ms);
  EXPECT_EQ(rig.run_on(kStart + 100ms), PumpWait::sample);
  EXPECT_EQ(rig.accepted(), (std::vector<Tid>{3, 2, 1, 0, 6}));
  EXPECT_EQ(rig.gaps, (std::map<Tid, Tid>{{4, 2}}));
}

TEST_F(NewestFirstWithARate, HistoryComesWhileASampleWaitsForItsTime) {
  rig.write(8);
  start_at(10, 0, 7, {4, 6});
  EXPECT_EQ(rig.run_on(), PumpWait::sample);
  EXPECT_EQ(rig.accepted(), (std::vector<Tid>{7, 6, 3, 2, 1, 0}));
  EXPECT_EQ(rig.caught_up, 1);
}

TEST(NewestFirstSmall, AFewSmallSamplesKeepTheirOrder) {
  PumpRig rig(kSmall, 4096);
  const auto in_order =
      static_cast<int>(SamplePump::kInOrderBytes / (kSmall + SamplePump::kHeaderBytes));
  rig.newest_first = true;
  SamplePump::Plan plan;
  plan.newest_first = true;
  rig.start(plan);
  rig.write(in_order);
  EXPECT_EQ(rig.run_on(), PumpWait::sample);
  EXPECT_EQ(rig.accepted(), tids(0, in_order - 1));
  rig.write(in_order + 1);
  EXPECT_EQ(rig.run_on(), PumpWait::sample);
  const std::vector<Tid> accepted = rig.accepted();
  EXPECT_EQ(accepted[static_cast<std::size_t>(in_order)], 2 * in_order);
  EXPECT_EQ(accepted.back(), 2 * in_order - 1);
}

class ManySmall : public testing::Test {
 protected:
  static constexpr Tid kInOrder =
      static_cast<Tid>(SamplePump::kInOrderBytes / (kSmall + SamplePump::kHeaderBytes));
  static constexpr Tid kDepth = 16 * kInOrder;

  explicit ManySmall(Tid depth = kDepth) : rig(kSmall, static_cast<std::uint64_t>(depth)) {
    rig.newest_first = true;
  }
  void start(SamplePump::Plan plan) {
    plan.newest_first = true;
    rig.start(plan);
  }
  // The first samples of the pieces that were sent.
  std::vector<Tid> pieces() {
    std::vector<Tid> found;
    Tid last = kNoTid - 1;
    for (const Tid tid : rig.accepted()) {
      if (tid != last + 1 || tid - found.back() == kInOrder) found.push_back(tid);
      last = tid;
    }
    return found;
  }

  PumpRig rig;
};

TEST_F(ManySmall, NewerSamplesInterruptWhatGoesInItsOrder) {
  start({});
  rig.write(6 * kInOrder);
  rig.peer.room = 3 * SamplePump::kInOrderBytes / 2;
  PumpWait wait = PumpWait::turn;
  while (wait == PumpWait::turn) wait = rig.run();
  EXPECT_EQ(wait, PumpWait::output);
  rig.write(2 * kInOrder);
  const Tid newest = 8 * kInOrder - 1;
  rig.peer.room = MemoryPeer::kAll;
  EXPECT_EQ(rig.run_on(), PumpWait::sample);
  const std::vector<Tid> accepted = rig.accepted();
  const auto then = std::find(accepted.begin(), accepted.end(), newest);
  ASSERT_NE(then, accepted.end());
  ASSERT_NE(then, accepted.begin());
  EXPECT_LT(then[-1], 2 * kInOrder);
  EXPECT_EQ(then[1], then[-1] + 1) << "goes on where it was";
  EXPECT_EQ(std::set<Tid>(accepted.begin(), accepted.end()).size(), accepted.size());
  EXPECT_EQ(accepted.size(), static_cast<std::size_t>(newest + 1));
}

TEST_F(ManySmall, NewerSamplesWaitForTheNextTurn) {
  start({});
  rig.write(4 * kInOrder);
  const Tid newest = 4 * kInOrder - 1;
  int sends = 0;
  rig.peer.after_send = [&] {
    if (++sends > 1) rig.write();
  };
  EXPECT_EQ(rig.run(), PumpWait::turn);
  const std::vector<Tid> turn = rig.accepted();
  EXPECT_EQ(turn.front(), newest);
  EXPECT_EQ(std::count_if(turn.begin(), turn.end(), [&](Tid tid) { return tid > newest; }), 0);
  rig.peer.after_send = nullptr;
  EXPECT_EQ(rig.run(), PumpWait::turn);
  EXPECT_GT(rig.accepted()[turn.size()], newest) << "before what is left of the others";
}

TEST_F(ManySmall, WhatTheNetworkCarriesSoonKeepsItsOrder) {
  const auto order_at = [&](std::uint64_t carried_bytes_per_s, std::uint64_t unsent_bytes = 1) {
    rig.peer.progress.emplace().carried_bytes_per_s = carried_bytes_per_s;
    rig.peer.progress->unsent_bytes = unsent_bytes;
    rig.peer.sent.clear();
    rig.write();
    start({rig.ring.reader().newest(), kNoTid, 0});
    rig.write(2 * kInOrder);
    EXPECT_EQ(rig.run_on(), PumpWait::sample);
    const std::vector<Tid> order = rig.accepted();
    return std::is_sorted(order.begin(), order.end());
  };
  constexpr auto kBytes = 2 * kInOrder * (kSmall + SamplePump::kHeaderBytes);
  constexpr std::uint64_t kPerSecond = std::chrono::seconds(1) / SamplePump::kSmallInOrderFor;
  EXPECT_TRUE(order_at(kBytes * (kPerSecond + 1)));
  EXPECT_FALSE(order_at(kBytes * (kPerSecond - 1)));
  EXPECT_TRUE(order_at(kBytes * (kPerSecond - 1), 0)) << "this PC was late";
}

// In each second some samples are written, and the network takes some.
class SmallBacklog : public ManySmall {
 protected:
  using ManySmall::ManySmall;
  static constexpr std::size_t kFrameBytes = kSmall + SamplePump::kHeaderBytes;

  void pass_second(int second, int written, std::size_t carried) {
    rig.write(written);
    rig.peer.room = carried * kFrameBytes;
    PumpWait wait = PumpWait::turn;
    for (int turns = 0; turns < 100 && wait != PumpWait::sample && rig.peer.room > 0; ++turns) {
      run_turns(rig.loop);
      wait = rig.run(kStart + second * 1s);
    }
  }
};

TEST_F(SmallBacklog, IsNotGivenUpWhileItBecomesLess) {
  constexpr int kWritten = 2 * kInOrder;
  rig.write(4 * kWritten);  // during a cut of 4 s
  SamplePump::Plan plan{0, 4 * kWritten - 1, 0};
  plan.backlog_from = 0;
  start(plan);
  for (int second = 1; second < 40; ++second) pass_second(second, kWritten, kWritten + 100);
  EXPECT_EQ(rig.pump->lost(), 0u);
}

class SmallBacklogInALongHistory : public SmallBacklog {
 protected:
  SmallBacklogInALongHistory() : SmallBacklog(128 * kInOrder) {}  // a minute
};

TEST_F(SmallBacklogInALongHistory, IsNotGivenUpWhileTheRingHoldsIt) {
  constexpr int kWritten = 2 * kInOrder;
  start({});
  for (int second = 1; second < 200; ++second) pass_second(second, kWritten, kWritten - 60);
  EXPECT_EQ(rig.pump->lost(), 0u);
}

TEST_F(SmallBacklog, IsGivenUpAtOnceWhenItOnlyBecomesMore) {
  start({});
  rig.write();
  EXPECT_EQ(rig.run_on(), PumpWait::sample);
  constexpr int kWritten = 2 * kInOrder;
  int second = 0;
  while (rig.pump->lost() == 0 && second < 40) pass_second(++second, kWritten, kInOrder);
  EXPECT_LT(second, 16);
  EXPECT_EQ(rig.ring.reader().oldest(), 0) << "nothing was overwritten";
  for (int more = 0; more < 5; ++more) {
    const std::uint64_t lost = rig.pump->lost();
    pass_second(++second, kWritten, kInOrder);
    EXPECT_GT(rig.pump->lost(), lost);
  }
}

TEST_F(NewestFirst, LargeBacklogComesNewestFirst) {
  rig.write(12);
  SamplePump::Plan plan{0, 11, 0};
  plan.backlog_from = 0;
  start(plan);
  EXPECT_EQ(rig.run_on(), PumpWait::sample);
  const std::vector<Tid> order = rig.accepted();
  EXPECT_TRUE(std::is_sorted(order.rbegin(), order.rend()));
}

// A writer, a network and a receiver that do anything.
TEST_F(SmallBacklog, EachSampleIsSentOrLostOnce) {
  for (unsigned seed = 0; seed < (test::kIsSanitized ? 16 : 48); ++seed) {
    std::mt19937 random(seed);
    const auto up_to = [&](int most) { return std::uniform_int_distribution(0, most)(random); };
    const int many = seed % 8 ? 1 : 64;  // of tiny ones a turn is shorter than 64 KiB
    PumpRig any(many > 1 ? 8 : 2000, 64ULL * static_cast<unsigned>(many));
    any.newest_first = true;
    any.write(up_to(100 * many));
    const Tid newest = any.ring.reader().newest();
    SamplePump::Plan plan{up_to(static_cast<int>(newest) + 1), newest, 0, true};
    plan.held.begin = up_to(100 * many);
    plan.held.end = plan.held.begin + (up_to(40) - 10) * many;
    plan.backlog_from = up_to(2) ? up_to(100 * many) : kNoTid;
    any.start(plan);
    MonoTime now = kStart;
    for (int step = 0; step < 100; ++step) {
      any.write(up_to(3) ? up_to(20 * many) : 0);
      any.peer.progress.emplace().unsent_bytes = static_cast<std::uint64_t>(up_to(1));
      any.peer.progress->carried_bytes_per_s = static_cast<std::uint64_t>(up_to(10'000'000));
      any.peer.room = static_cast<std::size_t>(up_to(1) ? up_to(50'000) : up_to(3'000));
      run_turns(any.loop);
      any.run(now += up_to(300) * 1ms);
    }
    any.peer.room = MemoryPeer::kAll;
    EXPECT_EQ(any.run_on(now), PumpWait::sample);
    std::map<Tid, int> times;
    for (Tid tid = plan.first; tid <= any.ring.reader().newest(); ++tid) {
      const bool is_held = tid >= plan.held.begin && tid < plan.held.end && tid <= newest;
      times[tid] = is_held ? 1 : 0;
    }
    for (const Tid tid : any.accepted()) ++times[tid];
    for (const net::Frame& frame : frames_of(any.peer.sent)) {
      if (!frame.has_gap()) continue;
      for (std::uint64_t i = 0; i < frame.gap().count(); ++i) {
        ++times[frame.gap().first_tid() + static_cast<Tid>(i)];
      }
    }
    for (const auto& [tid, count] : times) ASSERT_EQ(count, 1) << "seed " << seed << ", " << tid;
  }
}

TEST_F(ManySmall, HistoryComesNewestFirstAndBacklogInItsOrder) {
  rig.peer.progress.emplace();  // of a connection that has sent everything
  const Tid newest = kDepth / 2;
  rig.write(newest + 1);
  start({0, newest, 0});
  EXPECT_EQ(rig.run_on(), PumpWait::sample);
  const std::vector<Tid> all = pieces();
  ASSERT_GT(all.size(), 2u);
  EXPECT_EQ(all[0], newest);
  EXPECT_EQ(all[1], newest - kInOrder);
  rig.peer.sent.clear();
  SamplePump::Plan plan{0, newest, 0};
  plan.backlog_from = 2 * kInOrder;
  start(plan);
  EXPECT_EQ(rig.run_on(), PumpWait::sample);
  const std::vector<Tid> rest = pieces();
  ASSERT_GT(rest.size(), 4u);
  EXPECT_EQ(rest[0], newest);
  EXPECT_EQ(rest[1], 2 * kInOrder);
  EXPECT_EQ(rest[2], 3 * kInOrder);
  EXPECT_EQ(rest.back(), 0);
  EXPECT_EQ(rig.accepted().size(), static_cast<std::size_t>(newest + 1));
}

}  // namespace
}  // namespace dssm::daemon
