// SPDX-License-Identifier: Apache-2.0
//
// A mirror gives the same answers as the owner's ring: random reads by time and by tid of the same
// streams on three hosts, during writes and in pauses, give the same tids, times, clock errors and
// bytes.
#include <atomic>
#include <cstring>
#include <random>
#include <thread>

#include "tests/process/network/fleet.hpp"
#include "tests/process/network/known_samples.hpp"

namespace dssm::test {
namespace {

using namespace std::chrono_literals;

constexpr int kHosts = 3;
constexpr int kRounds = 10;
constexpr int kReadsByTime = 1'000'000 / kSlowness;  // of all streams, each on all hosts

// One stream, its writer on pc1, and a reader on each host; [0] is the owner's.
struct Watched {
  KnownStream known;
  Tid history = 0;    // samples written before the first read
  int per_round = 0;  // samples written in each round
  int percent_of_reads = 0;
  RawWriter writer;
  std::vector<RawReader> readers;
  std::vector<std::byte> scratch = std::vector<std::byte>(known.payload_bytes);

  void write_next() {
    const SampleInfo info = known.info(writer.newest_tid() + 1);
    known.fill(scratch, 1, info.tid);
    ASSERT_EQ(writer.write(scratch, info.time, info.clock_error), info.tid);
  }
};

class Equality : public NetworkTest {
 protected:
  void watch(const KnownStream& known, Tid history, int per_round, int percent_of_reads) {
    streams.push_back({known,
                       history,
                       per_round,
                       percent_of_reads,
                       sessions[0].create_raw(known.id, known.type(), known.history()).value(),
                       {}});
    while (streams.back().writer.newest_tid() + 1 < history) streams.back().write_next();
  }

  // Reads by `read(reader, payload, info)` on all hosts, and compares. True if all reads were ok;
  // while the stream is written, `too_old` and `not_yet` may occur on one host only.
  template <class Read>
  bool compare(Watched& stream, Read read, bool paused) {
    SampleInfo infos[kHosts];
    ReadStatus statuses[kHosts];
    for (std::size_t host = 0; host < kHosts; ++host) {
      payloads[host].resize(stream.known.payload_bytes);
      statuses[host] = read(stream.readers[host], payloads[host], infos[host]);
    }
    for (std::size_t host = 1; host < kHosts; ++host) {
      if (paused) {
        EXPECT_EQ(name_of(statuses[host]), name_of(statuses[0]));
      }
      if (statuses[host] != ReadStatus::ok || statuses[0] != ReadStatus::ok) return false;
      EXPECT_EQ(infos[host].tid, infos[0].tid);
      EXPECT_EQ(infos[host].time, infos[0].time) << "of tid " << infos[0].tid;
      EXPECT_EQ(infos[host].clock_error, infos[0].clock_error) << "of tid " << infos[0].tid;
      EXPECT_TRUE(payloads[host] == payloads[0]) << "bytes of tid " << infos[0].tid;
    }
    return true;
  }

  // A random time between the samples `first` and `last`, or shortly outside.
  Time random_time(const Watched& stream, Tid first, Tid last) {
    const std::int64_t margin = 3 * to_ns(stream.known.cycle);
    std::uniform_int_distribution<std::int64_t> times(to_ns(stream.known.info(first).time) - margin,
                                                      to_ns(stream.known.info(last).time) + margin);
    return time_from_ns(times(random));
  }

  // Waits until all mirrors have all that the owner has.
  void await_mirrors(Watched& stream) {
    for (RawReader& reader : stream.readers) {
      ASSERT_EQ(reader.wait_for_tid(stream.writer.newest_tid(), kNever), WaitStatus::ready);
      EXPECT_EQ(reader.newest_tid(), stream.writer.newest_tid());
      SampleInfo info;
      await("nothing is on its way", [&] {
        return reader.find(stream.known.info(reader.oldest_tid()).time, info) !=
               ReadStatus::arriving;
      });
      EXPECT_EQ(reader.oldest_tid(), stream.readers[0].oldest_tid()) << "not the same window";
    }
  }

  void compare_by_time_in_a_pause(Watched& stream, int reads) {
    await_mirrors(stream);
    for (int i = 0; i < reads && !HasFailure(); ++i) {
      const Tid oldest = stream.readers[0].oldest_tid();
      // A third of the reads are of samples from before the first read.
      const Tid newest = i % 3 == 0 ? stream.history - 1 : stream.writer.newest_tid();
      const Time t = random_time(stream, std::min(oldest, newest), newest);
      compare(
          stream,
          [&](RawReader& reader, auto& payload, SampleInfo& info) {
            return reader.read_at(t, payload, info);
          },
          true);
    }
  }

  // Until `done`: reads by tid, and by time on streams whose times never decrease.
  void compare_while_written(const std::atomic<bool>& done) {
    while (!done && !HasFailure()) {
      for (Watched& stream : streams) {
        std::uniform_int_distribution<Tid> tids(stream.readers[0].oldest_tid(),
                                                stream.readers[kHosts - 1].newest_tid());
        const Tid tid = tids(random);
        compared_while_written += compare(
            stream,
            [&](RawReader& reader, auto& payload, SampleInfo& info) {
              return reader.read_tid(tid, payload, info);
            },
            false);
        if (stream.known.jitter >= stream.known.cycle / 2) continue;
        // Up to the newest sample that all hosts have, the answer is final. Any mirror may be
        // older, also than `tid`.
        Tid newest = stream.readers[0].newest_tid();
        for (const RawReader& reader : stream.readers)
          newest = std::min(newest, reader.newest_tid());
        const Time t = std::min(random_time(stream, std::min(tid, newest), newest),
                                stream.known.info(newest).time);
        compared_while_written += compare(
            stream,
            [&](RawReader& reader, auto& payload, SampleInfo& info) {
              return reader.read_at(t, payload, info);
            },
            false);
      }
    }
  }

  const std::uint64_t seed = number_from_environment("DSSM_TEST_SEED", std::random_device{}());
  std::mt19937_64 random{seed};
  std::vector<Session> sessions;
  std::vector<Watched> streams;
  std::vector<std::byte> payloads[kHosts];
  std::uint64_t compared_while_written = 0;
};

TEST_F(Equality, MirrorsAnswerEveryReadAsTheOwnerDoes) {
  if (!make_fleet(kHosts)) return;
  SCOPED_TRACE(testing::Message() << "DSSM_TEST_SEED=" << seed);
  for (int host = 1; host <= kHosts; ++host) sessions.push_back(fleet->session(host));
  watch({{"regular", 0, "pc1"}, 64, 1 << 15, 1ms, 0ms, 1}, 12'000, 500, 45);
  watch({{"irregular", 0, "pc1"}, 64, 1 << 13, 2ms, 30ms, 2}, 3'000, 250, 45);
  watch({{"large", 0, "pc1"}, 64 << 10, 512, 20ms, 5ms, 3}, 250, 25, 10);
  for (Watched& stream : streams) {
    for (Session& session : sessions) {
      stream.readers.push_back(session.await_raw_reader(stream.known.id, kNever).value());
    }
    await_mirrors(stream);  // opening returns before the history has arrived
  }
  for (int round = 0; round < kRounds && !HasFailure(); ++round) {
    std::atomic<bool> done = false;
    std::thread write([&] {
      for (int tick = 0; tick < 500; ++tick) {
        for (Watched& stream : streams) {
          if (tick % (500 / stream.per_round) == 0) stream.write_next();
        }
        std::this_thread::sleep_for(1ms);  // the streams' rate, not a wait for anything
      }
      done = true;
    });
    compare_while_written(done);
    write.join();
    for (Watched& stream : streams) {
      compare_by_time_in_a_pause(stream, kReadsByTime / 100 / kRounds * stream.percent_of_reads);
    }
  }
  EXPECT_GT(compared_while_written, 0u);
  for (Watched& stream : streams) {
    EXPECT_EQ(stream.readers[0].oldest_tid(), 0)
        << "the samples from before the readers are missing";
    // The writer laps the ring at full speed; afterwards the same samples remain on all hosts.
    for (std::uint64_t i = 0; i < 2 * stream.known.depth; ++i) stream.write_next();
    stream.history = stream.writer.newest_tid();
    compare_by_time_in_a_pause(stream, 1000);
    for (RawReader& reader : stream.readers) EXPECT_EQ(reader.restarts(), 0u);
  }
}

}  // namespace
}  // namespace dssm::test
