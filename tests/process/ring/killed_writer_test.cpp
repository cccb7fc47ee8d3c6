// SPDX-License-Identifier: Apache-2.0
//
// A writer that dies at any instruction of a write: the parent single-steps a child through one
// write, kills it after 0, 1, 2 ... instructions, and each time readers and the next writer must
// find a ring in order. Then the same with children killed at random moments while they write for
// ever.
#include <sys/prctl.h>
#include <sys/ptrace.h>
#include <sys/wait.h>

#include <csignal>
#include <cstdio>
#include <random>

#include "core/ring/copy.hpp"
#include "tests/unit/core/ring/test_ring.hpp"

namespace dssm::ring {
namespace {

constexpr std::size_t kPayloadBytes = 64;

// A sanitizer multiplies instructions and the cost of a fork: it gets a sample of them.
#if defined(DSSM_TSAN) || defined(__SANITIZE_ADDRESS__)
constexpr bool kSanitized = true;
constexpr int kStride = 997;
constexpr int kPublishingStride = 1999;
constexpr int kRounds = 50;
#else
constexpr bool kSanitized = false;
constexpr int kStride = 1;
constexpr int kPublishingStride = 1;
constexpr int kRounds = 2000;
#endif

// What every sample must be: payload_for its tid.
void expect_whole(const RingReader& reader) {
  std::byte out[kPayloadBytes];
  for (Tid tid = std::max<Tid>(reader.oldest(), 0); tid <= reader.newest(); ++tid) {
    SampleInfo info;
    ASSERT_EQ(reader.read(tid, out, info), ReadStatus::ok) << "tid " << tid;
    ASSERT_EQ(std::vector<std::byte>(out, out + kPayloadBytes), payload_for(tid, kPayloadBytes));
    Tid found = kNoTid;
    ASSERT_EQ(reader.find(info.time, found), ReadStatus::ok);
    ASSERT_GE(found, tid) << "the newest sample at or before a sample's time is it or a newer one";
    SampleInfo other;
    ASSERT_EQ(reader.stamp(found, other), ReadStatus::ok);
    ASSERT_LE(other.time, info.time);
  }
}

// How the times of a test run; the step backwards takes another path through the writer.
using TimeOf = std::int64_t (*)(Tid);
std::int64_t forwards(Tid tid) { return 1000 * tid; }
std::int64_t zigzag(Tid tid) { return 1000 * tid - (tid % 2 ? 1500 : 0); }

struct Deaths {
  int instructions = 0;  // that one write takes
  int rings_checked = 0;
};

constexpr std::uint64_t kPublisher = 77;

// publishes: as dssmd for kPublisher, which has written before.
Deaths die_at_every_instruction(TimeOf time_of, bool publishes = false) {
  const TestRing ring(kPayloadBytes, 5);
  const RingReader reader = ring.reader();
  const PublisherCursors cursors(ring.mapping->header());
  RingWriter survivor = ring.writer();
  if (publishes) {
    survivor.try_publish({kPublisher, 7}, payload_for(0, kPayloadBytes), {}, {});
  }
  Deaths deaths;
  bool finished = false;
  for (int steps = 0; !finished; steps += publishes ? kPublishingStride : kStride) {
    const Tid next = reader.newest() + 1;
    const std::int64_t number = cursors.last_untrusted(kPublisher).number + 1;
    const auto payload = payload_for(next, kPayloadBytes);
    const pid_t child = ::fork();
    if (child == 0) {
      RingWriter writer = ring.writer();
      ::ptrace(PTRACE_TRACEME, 0, nullptr, nullptr);
      ::raise(SIGSTOP);
      if (publishes) {
        writer.try_publish({kPublisher, number}, payload, time_from_ns(time_of(next)), Duration(0));
      } else {
        writer.write(payload, time_from_ns(time_of(next)), Duration(0));
      }
      ::_exit(0);
    }
    int status = 0;
    ::waitpid(child, &status, 0);
    for (int i = 0; i < steps && WIFSTOPPED(status); ++i) {
      ::ptrace(PTRACE_SINGLESTEP, child, nullptr, nullptr);
      ::waitpid(child, &status, 0);
    }
    finished = WIFEXITED(status);
    if (!finished) {
      ::kill(child, SIGKILL);
      ::waitpid(child, &status, 0);
    }
    expect_whole(reader);
    // The next writer gets the lock at once and continues the tids.
    const Tid expected = reader.newest() + 1;
    EXPECT_TRUE(expected == next || expected == next + 1);
    // It is known whose sample that was exactly when it is there.
    const auto expect_noted = [&] {
      if (!publishes) return;
      EXPECT_EQ(cursors.last_untrusted(kPublisher).number, expected == next ? number - 1 : number);
      EXPECT_LT(cursors.last_untrusted(kPublisher).tid, expected);
    };
    expect_noted();
    EXPECT_EQ(survivor.write(payload_for(expected, kPayloadBytes), time_from_ns(time_of(expected)),
                             Duration(0)),
              expected);
    expect_whole(reader);
    expect_noted();
    if (testing::Test::HasFailure()) {
      std::printf("after %d instructions\n", steps);
      return deaths;
    }
    deaths.instructions = steps;
    ++deaths.rings_checked;
  }
  return deaths;
}

TEST(KilledWriter, LeavesARingInOrderAtEveryInstruction) {
  const Deaths deaths = die_at_every_instruction(forwards);
  std::printf("killed at %d places of %d instructions\n", deaths.rings_checked,
              deaths.instructions);
  EXPECT_GT(deaths.rings_checked, 5);
  EXPECT_GT(deaths.instructions, 100);
}

TEST(KilledWriter, LeavesARingInOrderAtEveryInstructionOfAStepBackwards) {
  const Deaths deaths = die_at_every_instruction(zigzag);
  std::printf("killed at %d places of %d instructions\n", deaths.rings_checked,
              deaths.instructions);
  EXPECT_GT(deaths.rings_checked, 5);
  EXPECT_GT(deaths.instructions, 100);
}

TEST(KilledWriter, KnowsAtEveryInstructionWhetherWhatItPublishesIsWritten) {
  const Deaths deaths = die_at_every_instruction(forwards, true);
  std::printf("killed at %d places of %d instructions\n", deaths.rings_checked,
              deaths.instructions);
  EXPECT_GT(deaths.rings_checked, 5);
  EXPECT_GT(deaths.instructions, 100);
}

// What a writer changes in a ring's header, step by step.
struct HeaderState {
  explicit HeaderState(const RingHeader& header) : top(header.top.load()) {
    std::memcpy(cursors, header.publishers, sizeof cursors);
  }
  bool operator==(const HeaderState& other) const {
    return top == other.top && std::memcmp(cursors, other.cursors, sizeof cursors) == 0;
  }
  Tid top;
  std::byte cursors[sizeof(RingHeader::publishers)];
};

// Runs `act` in a child and kills it right after its `changes`-th change to the header, which is as
// good as at each instruction until the next one. Returns whether it came to its end before.
template <class Act>
bool finishes_before(int changes, const RingHeader& header, Act act) {
  const pid_t child = ::fork();
  if (child == 0) {
    ::ptrace(PTRACE_TRACEME, 0, nullptr, nullptr);
    ::raise(SIGSTOP);
    act();
    ::_exit(0);
  }
  int status = 0;
  ::waitpid(child, &status, 0);
  for (HeaderState before(header); WIFSTOPPED(status) && changes > 0;) {
    ::ptrace(PTRACE_SINGLESTEP, child, nullptr, nullptr);
    ::waitpid(child, &status, 0);
    const HeaderState now(header);
    if (!(now == before)) --changes;
    before = now;
  }
  if (WIFEXITED(status)) return true;
  ::kill(child, SIGKILL);
  ::waitpid(child, &status, 0);
  return false;
}

class KilledDaemon : public testing::Test {
 protected:
  void SetUp() override {
    if (kSanitized) {
      GTEST_SKIP() << "each instruction is looked at, and a sanitizer multiplies them; a plain "
                      "build runs this";
    }
  }
  void write() { survivor.write(payload, {}, Duration(0)); }
  void publish(std::uint64_t publisher, std::int64_t number) {
    RingWriter writer = ring.writer();
    writer.try_publish({publisher, number}, payload, {}, Duration(0));
  }
  std::int64_t last(std::uint64_t publisher) const {
    return cursors.last_untrusted(publisher).number;
  }

  const TestRing ring{kPayloadBytes, 5};
  const RingHeader& header = ring.mapping->header();
  const PublisherCursors cursors{ring.mapping->header()};
  RingWriter survivor = ring.writer();
  const std::vector<std::byte> payload = payload_for(0, kPayloadBytes);
};

TEST_F(KilledDaemon, DoesNotTakeForANewPublishersWhatAForgottenOneWrote) {
  for (std::uint64_t i = 0; i < kMaxPublishers; ++i) publish(i, 1000);
  int changes = 0;
  for (bool finished = false; !finished;) {
    const std::uint64_t fresh = 1'000'000 + static_cast<std::uint64_t>(++changes);
    const Tid before = ring.reader().newest();
    finished = finishes_before(changes, header, [&] { publish(fresh, 5); });
    const std::int64_t expected = ring.reader().newest() > before ? 5 : -1;
    EXPECT_EQ(last(fresh), expected) << "after " << changes << " changes";
    write();
    EXPECT_EQ(last(fresh), expected) << "after " << changes << " changes";
    publish(2'000'000 + static_cast<std::uint64_t>(changes), 1000);  // no note stays free
  }
  EXPECT_GT(changes, 5);
}

// And the one who recovers what a dssmd has left dies as well.
TEST_F(KilledDaemon, IsRecoveredByWritersThatDieToo) {
  publish(kPublisher, 7);
  int changes = 0;
  for (bool finished = false; !finished;) {
    const pid_t daemon = ::fork();
    if (daemon == 0) {
      RingWriter writer = ring.writer();
      writer.begin();
      cursors.advance({kPublisher, 8}, writer.newest() + 1);
      ::_exit(0);  // with the lock
    }
    int status = 0;
    ::waitpid(daemon, &status, 0);
    finished = finishes_before(++changes, header, [&] { write(); });
    EXPECT_EQ(last(kPublisher), 7) << "after " << changes << " changes";
    write();
    EXPECT_EQ(last(kPublisher), 7) << "after " << changes << " changes";
  }
  EXPECT_GT(changes, 3);
}

TEST(KilledWriter, LeavesARingInOrderAtThousandsOfRandomMoments) {
  const std::uint64_t seed = std::random_device{}();
  std::mt19937_64 random(seed);
  SCOPED_TRACE(testing::Message() << "seed " << seed);
  const TestRing ring(kPayloadBytes, 7);
  const RingReader reader = ring.reader();
  for (int round = 0; round < kRounds; ++round) {
    const Tid before = reader.newest();
    const pid_t child = ::fork();
    if (child == 0) {
      ::prctl(PR_SET_PDEATHSIG, SIGKILL);
      RingWriter writer = ring.writer();
      for (Tid tid = before + 1;; ++tid) {
        writer.write(payload_for(tid, kPayloadBytes), time_from_ns(zigzag(tid)), Duration(0));
      }
    }
    // Not a fixed time: until it has written a random number of samples.
    const Tid enough = before + 1 + static_cast<Tid>(random() % 200);
    while (reader.newest() < enough) {
      const std::uint32_t announced = ring.bell->announce();
      if (reader.newest() < enough) (void)ring.bell->sleep(announced, kNever);
    }
    ::kill(child, SIGKILL);
    ::waitpid(child, nullptr, 0);
    expect_whole(reader);
    ASSERT_FALSE(HasFailure()) << "round " << round;
  }
}

}  // namespace
}  // namespace dssm::ring
