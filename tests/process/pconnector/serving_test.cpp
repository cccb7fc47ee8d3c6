// SPDX-License-Identifier: Apache-2.0
//
// PConnector against a real dssmd.
#include <gtest/gtest.h>
#include <signal.h>

#include <dssm/dssm.hpp>
#include <numeric>
#include <random>
#include <thread>

#include "tests/process/fleet/fleet_tools.hpp"
#include "tests/support/daemon_process.hpp"
#include "tests/support/largest_payload.hpp"
#include "tests/support/samples.hpp"
#include "tests/support/session.hpp"

namespace dssm::test {
namespace {

using namespace std::chrono_literals;

Time time_of(Tid tid) { return time_from_ns(tid * 1'000'000); }

struct PConnectorServing : testing::Test {
  DaemonProcess daemon{{"--log-level", "warning"}, "pc2"};
  Session session = connect(daemon);

  PConnectorOptions options() const {
    return {.address = daemon.address(), .program = "test", .request_timeout = 60s};
  }
  PConnector open(const std::string& name = "lidar") const {
    const TypeInfo type = type_of<Numbered>();
    auto con = PConnector::open(StreamId::parse(name).value(), options(), &type);
    EXPECT_TRUE(con) << con.error().message;
    return std::move(con).value();
  }
  Writer<Numbered> make(History history = {64, 1ms}, const std::string& name = "lidar") {
    return session.create<Numbered>(name, history).value();
  }
  static void write(Writer<Numbered>& writer, Tid tid) {
    ASSERT_EQ(writer.write(numbered(tid), time_of(tid), Duration(tid)), tid);
  }
};

void expect_is(const Numbered& sample, const SampleInfo& info, Tid tid) {
  EXPECT_EQ(info.tid, tid);
  EXPECT_EQ(info.time, time_of(tid));
  EXPECT_EQ(info.clock_error, Duration(tid));
  EXPECT_EQ(sample.number, tid);
  EXPECT_TRUE(is_whole(sample));
}

// Takes the next sample, waiting for it.
ReadStatus await_next(PConnector& con, Numbered& sample, SampleInfo& info) {
  for (;;) {
    EXPECT_EQ(con.wait(kNever), WaitStatus::ready);
    const auto status = con.read_next(writable_bytes(sample), info);
    if (!status) {
      ADD_FAILURE() << status.error().message;
      return ReadStatus::not_yet;
    }
    if (*status != ReadStatus::not_yet) return *status;
  }
}

void expect_next(PConnector& con, Tid tid) {
  Numbered sample;
  SampleInfo info;
  ASSERT_EQ(await_next(con, sample, info), ReadStatus::ok);
  expect_is(sample, info, tid);
}

TEST_F(PConnectorServing, KnowsTheStream) {
  auto writer = make({100, 5ms});
  const PConnector con = open();
  EXPECT_EQ(con.id().str(), "lidar:0@pc2");
  EXPECT_EQ(con.type(), type_of<Numbered>());
  EXPECT_EQ(con.payload_bytes(), sizeof(Numbered));
  EXPECT_EQ(con.depth(), 100u);
  EXPECT_EQ(con.cycle(), 5ms);
  EXPECT_EQ(con.incarnation(), writer.incarnation());
  EXPECT_EQ(con.address(), daemon.address());
  EXPECT_TRUE(con.is_connected());
}

TEST_F(PConnectorServing, RefusesWithAReason) {
  const auto writer = make();
  const auto none = PConnector::open({"radar", 0, {}}, options());
  ASSERT_FALSE(none);
  EXPECT_EQ(none.error().code, Errc::not_found) << none.error().message;
  EXPECT_NE(none.error().message.find("radar"), std::string::npos) << none.error().message;
  const TypeInfo other{"Image", 100, 1, {}};
  const auto type = PConnector::open({"lidar", 0, {}}, options(), &other);
  EXPECT_EQ(type.error().code, Errc::type_mismatch) << type.error().message;
  const auto joined = PConnector::create({"lidar", 0, {}}, other, {16, 1ms}, options());
  EXPECT_EQ(joined.error().code, Errc::type_mismatch) << joined.error().message;
  const auto host = PConnector::open({"lidar", 0, "pc9"}, options());
  ASSERT_FALSE(host);
  EXPECT_NE(host.error().message.find("pc9"), std::string::npos) << host.error().message;
}

TEST_F(PConnectorServing, ReadsAsALocalReaderDoes) {
  auto writer = make({64, 1ms});
  auto con = open();
  auto local = session.open_reader<Numbered>("lidar").value();
  Numbered here, there;
  SampleInfo info_here, info_there;
  EXPECT_EQ(con.read_newest(writable_bytes(there), info_there).value(), ReadStatus::not_yet);
  EXPECT_EQ(con.newest_tid().value(), kNoTid);
  EXPECT_EQ(con.oldest_tid().value(), kNoTid);
  EXPECT_EQ(con.find(time_of(3)).value(), kNoTid);
  for (Tid tid = 0; tid < 200; ++tid) write(writer, tid);
  const std::random_device::result_type seed = std::random_device()();
  SCOPED_TRACE(testing::Message() << "seed " << seed);
  std::mt19937_64 random(seed);
  for (int i = 0; i < 2000; ++i) {
    const Tid tid = static_cast<Tid>(random() % 220) - 10;
    const Time time = time_of(tid) + Duration(static_cast<std::int64_t>(random() % 1'000'000));
    const auto by_tid = con.read_tid(tid, writable_bytes(there), info_there);
    ASSERT_TRUE(by_tid) << by_tid.error().message;
    ASSERT_EQ(*by_tid, local.read_tid(tid, here, info_here));
    if (*by_tid == ReadStatus::ok) expect_is(there, info_there, tid);
    const Duration age =
        i % 2 ? kAnyAge : Duration(static_cast<std::int64_t>(random() % 2'000'000));
    const auto by_time = con.read_at(time, writable_bytes(there), info_there, age);
    ASSERT_TRUE(by_time) << by_time.error().message;
    ASSERT_EQ(*by_time, local.read_at(time, here, info_here, age));
    if (*by_time == ReadStatus::ok) expect_is(there, info_there, info_here.tid);
    SampleInfo found;
    const bool is_there = local.find(time, found) == ReadStatus::ok;
    ASSERT_EQ(con.find(time).value(), is_there ? found.tid : kNoTid);
  }
  EXPECT_EQ(con.newest_tid().value(), 199);
  EXPECT_EQ(con.oldest_tid().value(), local.oldest_tid());
  info_there = {};
  EXPECT_EQ(con.read_at(time_of(199) + 2ms, writable_bytes(there), info_there, 1ms).value(),
            ReadStatus::stale);
  EXPECT_EQ(info_there.tid, kNoTid) << "set only when ok";
  EXPECT_EQ(con.read_newer(198, writable_bytes(there), info_there).value(), ReadStatus::ok);
  EXPECT_EQ(info_there.tid, 199);
  EXPECT_EQ(con.read_newer(199, writable_bytes(there), info_there).value(), ReadStatus::not_yet);
}

TEST_F(PConnectorServing, SubscribesFromWhereItIsAsked) {
  auto writer = make({64, 1ms});
  for (Tid tid = 0; tid < 40; ++tid) write(writer, tid);
  auto con = open();
  ASSERT_TRUE(con.subscribe({.start = Subscription::Start::oldest}));
  for (Tid tid = 0; tid < 40; ++tid) expect_next(con, tid);
  ASSERT_TRUE(con.subscribe({.start = Subscription::Start::tid, .tid = 30}));
  for (Tid tid = 30; tid < 40; ++tid) expect_next(con, tid);
  ASSERT_TRUE(con.subscribe({.start = Subscription::Start::time, .time = time_of(35) + 10us}));
  for (Tid tid = 35; tid < 40; ++tid) expect_next(con, tid);
  ASSERT_TRUE(con.subscribe({}));
  Numbered sample;
  SampleInfo info;
  EXPECT_EQ(con.read_next(writable_bytes(sample), info).value(), ReadStatus::not_yet);
  write(writer, 40);
  expect_next(con, 40);
  ASSERT_TRUE(con.unsubscribe());
  write(writer, 41);
  EXPECT_EQ(con.read_next(writable_bytes(sample), info).error().code, Errc::invalid_argument);
  EXPECT_EQ(con.read_newest(writable_bytes(sample), info).value(), ReadStatus::ok);
  EXPECT_EQ(info.tid, 41);
  EXPECT_EQ(con.lost_samples(), 0u);
}

TEST_F(PConnectorServing, CountsExactlyWhatTheRingLost) {
  auto writer = make({64, 1ms});
  write(writer, 0);
  auto con = open();
  ASSERT_TRUE(con.subscribe({.start = Subscription::Start::oldest}));
  expect_next(con, 0);
  // Stopped, dssmd sends nothing; what it missed is gone from the ring then.
  ::kill(daemon.pid(), SIGSTOP);
  for (Tid tid = 1; tid <= 1000; ++tid) write(writer, tid);
  ::kill(daemon.pid(), SIGCONT);
  std::uint64_t taken = 0;
  Numbered sample;
  SampleInfo info;
  while (info.tid != 1000) {
    ASSERT_EQ(await_next(con, sample, info), ReadStatus::ok);
    expect_is(sample, info, info.tid);
    ++taken;
  }
  EXPECT_GT(con.lost_samples(), 0u);
  EXPECT_EQ(con.lost_samples() + taken, 1000u);
}

TEST_F(PConnectorServing, TakesEverySampleOfAFastWriter) {
  constexpr Tid kCount = 200'000;
  auto writer = make({1U << 19, 1us});
  auto con = open();
  ASSERT_TRUE(con.subscribe({}));
  std::thread writing([&] {
    for (Tid tid = 0; tid < kCount; ++tid) write(writer, tid);
  });
  Numbered sample;
  SampleInfo info;
  for (Tid tid = 0; tid < kCount; ++tid) {
    ASSERT_EQ(await_next(con, sample, info), ReadStatus::ok);
    ASSERT_EQ(info.tid, tid);
    ASSERT_EQ(sample.number, tid);
  }
  writing.join();
  EXPECT_EQ(con.lost_samples(), 0u);
  const auto counters = con.counters();
  EXPECT_EQ(counters.samples, static_cast<std::uint64_t>(kCount));
  // A sample that is half here when a call of a busy program ends is moved.
  EXPECT_LE(counters.copied_payload_bytes, counters.samples * sizeof(Numbered) * 101 / 100)
      << "one copy at most";
  EXPECT_EQ(counters.reconnects, 0u);
}

TEST_F(PConnectorServing, SendsTheNewestOnly) {
  auto writer = make();
  auto con = open();
  for (Tid tid = 0; tid < 20; ++tid) write(writer, tid);
  ASSERT_TRUE(con.subscribe(
      {.start = Subscription::Start::oldest, .max_rate_hz = Subscription::kNewestOnly}));
  expect_next(con, 19);
  for (Tid tid = 20; tid < 30; ++tid) {
    write(writer, tid);
    expect_next(con, tid);
  }
  EXPECT_EQ(con.lost_samples(), 0u);
}

TEST_F(PConnectorServing, ThinsAtTheSource) {
  auto writer = make({1024, 1ms});
  auto con = open();
  const MonoTime begin = MonoClock::now();  // before anything can be sent
  ASSERT_TRUE(con.subscribe({.max_rate_hz = 50}));
  std::atomic<bool> stop = false;
  std::thread writing([&] {
    for (Tid tid = 0; !stop; ++tid) {
      write(writer, tid);
      std::this_thread::yield();
    }
  });
  Numbered sample;
  SampleInfo info;
  for (int i = 0; i < 10; ++i) {
    ASSERT_EQ(await_next(con, sample, info), ReadStatus::ok);
    EXPECT_EQ(sample.number, info.tid);
  }
  EXPECT_GE(MonoClock::now() - begin, 9 * 20ms);
  EXPECT_EQ(con.lost_samples(), 0u);
  stop = true;
  writing.join();
}

TEST_F(PConnectorServing, ResumesOverRestartsOfDssmdWhileTheWriterContinues) {
  auto writer = make({1U << 16, 1ms});
  write(writer, 0);
  auto con = open();
  ASSERT_TRUE(con.subscribe({.start = Subscription::Start::oldest}));
  Tid due = 0, next_tid = 1;
  for (int round = 0; round < 5; ++round) {
    for (int i = 0; i < 100; ++i) write(writer, next_tid++);
    while (due < next_tid - 50) expect_next(con, due++);
    daemon.kill_hard();
    for (int i = 0; i < 100; ++i) write(writer, next_tid++);
    daemon.start();
    for (int i = 0; i < 100; ++i) write(writer, next_tid++);
    while (due < next_tid) expect_next(con, due++);
  }
  EXPECT_EQ(con.lost_samples(), 0u);
  EXPECT_EQ(con.restarts(), 0u);
  EXPECT_EQ(con.counters().reconnects, 5u);
}

TEST_F(PConnectorServing, ReportsAStreamThatWasRecreated) {
  auto writer = make();
  for (Tid tid = 0; tid < 3; ++tid) write(writer, tid);
  auto con = open();
  ASSERT_TRUE(con.subscribe({.start = Subscription::Start::oldest}));
  for (Tid tid = 0; tid < 3; ++tid) expect_next(con, tid);
  ASSERT_TRUE(session.remove({"lidar", 0, {}}));
  auto recreated = make();
  write(recreated, 0);
  Numbered sample;
  SampleInfo info;
  ASSERT_EQ(await_next(con, sample, info), ReadStatus::restarted);
  expect_next(con, 0);
  write(recreated, 1);
  expect_next(con, 1);
  EXPECT_EQ(con.restarts(), 1u);
  EXPECT_EQ(con.incarnation(), recreated.incarnation());
  // And by request: told once, too.
  EXPECT_EQ(con.read_newest(writable_bytes(sample), info).value(), ReadStatus::restarted);
  EXPECT_EQ(con.read_newest(writable_bytes(sample), info).value(), ReadStatus::ok);
}

TEST_F(PConnectorServing, WritesAndReadsBackItsOwnTids) {
  auto con =
      PConnector::create({"made", 3, {}}, type_of<Numbered>(), {256, 1ms}, options()).value();
  auto local = session.open_reader<Numbered>("made:3").value();
  for (Tid tid = 0; tid < 20; ++tid) {
    const auto written = con.write(bytes_of(numbered(tid)), time_of(tid), Duration(tid));
    ASSERT_TRUE(written) << written.error().message;
    EXPECT_EQ(*written, tid);
    Numbered sample;
    SampleInfo info;
    ASSERT_EQ(local.read_newest(sample, info), ReadStatus::ok);
    expect_is(sample, info, tid);
  }
  for (Tid tid = 20; tid < 120; ++tid) {
    ASSERT_TRUE(con.post(bytes_of(numbered(tid)), time_of(tid), Duration(tid)));
  }
  EXPECT_EQ(con.flush(kNever).value(), 119);
  for (Tid tid = 0; tid < 120; ++tid) {
    Numbered sample;
    SampleInfo info;
    ASSERT_EQ(local.read_tid(tid, sample, info), ReadStatus::ok);
    expect_is(sample, info, tid);
  }
}

TEST_F(PConnectorServing, PostsEachSampleOnceOverRestartsOfDssmd) {
  constexpr Tid kCount = 20'000;
  auto ring = make({1U << 15, 1ms}, "posted");  // held here, so that it outlives dssmd
  auto local = session.open_reader<Numbered>("posted").value();
  PConnectorOptions wide = options();
  wide.max_unsent_samples = kCount;
  auto con = PConnector::open({"posted", 0, {}}, wide).value();
  for (Tid tid = 0; tid < kCount; ++tid) {
    ASSERT_TRUE(con.post(bytes_of(numbered(tid)), time_of(tid), Duration(tid)));
    if (tid % 4000 == 3999) {
      daemon.kill_hard();
      daemon.start();
    }
  }
  const auto flushed = con.flush(kNever);
  ASSERT_TRUE(flushed) << flushed.error().message;
  EXPECT_EQ(con.dropped_samples(), 0u);
  local.seek(kNoTid);
  Tid last = -1;
  Numbered sample;
  SampleInfo info;
  while (local.read_next(sample, info) == ReadStatus::ok) {
    ASSERT_EQ(sample.number, last + 1);
    EXPECT_TRUE(is_whole(sample));
    last = sample.number;
  }
  EXPECT_EQ(last, kCount - 1);
}

TEST_F(PConnectorServing, CarriesProperties) {
  auto writer = make();
  auto con = open();
  EXPECT_EQ(con.property().error().code, Errc::not_found);
  std::vector<std::byte> large(1U << 20);
  for (std::size_t i = 0; i < large.size(); ++i) large[i] = static_cast<std::byte>(i * 7);
  for (const std::size_t bytes : {std::size_t{1}, large.size()}) {
    const std::span property = std::span(large).first(bytes);
    const auto set = con.set_property(property);
    ASSERT_TRUE(set) << set.error().message;
    EXPECT_EQ(con.property().value(), std::vector(property.begin(), property.end()));
    EXPECT_EQ(session.property({"lidar", 0, {}}).value(), con.property().value());
  }
  const std::vector<std::byte> too_large((1U << 20) + 1);
  EXPECT_EQ(con.set_property(too_large).error().code, Errc::limit_exceeded);
}

TEST_F(PConnectorServing, ListsTheHostsStreams) {
  make({64, 1ms}, "lidar");
  make({64, 1ms}, "odometry:2");
  const auto streams = PConnector::list_streams(options());
  ASSERT_TRUE(streams) << streams.error().message;
  ASSERT_EQ(streams->size(), 2u);
  EXPECT_EQ((*streams)[0].id.str(), "lidar:0@pc2");
  EXPECT_EQ((*streams)[1].id.str(), "odometry:2@pc2");
  EXPECT_EQ((*streams)[1].type, type_of<Numbered>());
}

TEST_F(PConnectorServing, FindsAHostInTheCatalogOfTheLocalDssmd) {
  make();
  const DaemonProcess local({"--log-level", "warning", "--peer", daemon.address()}, "pc1");
  ::setenv("DSSM_SOCKET", local.socket_path().c_str(), 1);
  auto here = connect(local);
  await_up(here, "pc2");
  const auto con = PConnector::open({"lidar", 0, {}}, {.address = "pc2"});
  const auto by_name = PConnector::open({"lidar", 0, "pc2"});
  const auto none = PConnector::open({"lidar", 0, {}}, {.address = "pc7"});
  ::unsetenv("DSSM_SOCKET");
  ASSERT_TRUE(con) << con.error().message;
  EXPECT_EQ(con->address(), daemon.address());
  ASSERT_TRUE(by_name) << by_name.error().message;
  ASSERT_FALSE(none);
  EXPECT_NE(none.error().message.find("pc7"), std::string::npos) << none.error().message;
}

TEST_F(PConnectorServing, CarriesTheSmallestAndTheLargestSamples) {
  for (const std::size_t bytes : {std::size_t{1}, kLargestPayloadBytes}) {
    const StreamId id{"s" + std::to_string(bytes), 0, {}};
    auto writer = PConnector::create(id, {"", bytes, 1, {}}, {4, 1s}, options()).value();
    auto reader = PConnector::open(id, options()).value();
    ASSERT_TRUE(reader.subscribe({}));
    std::vector<std::byte> sent(bytes), received(bytes);
    std::mt19937_64 random(bytes);
    for (Tid tid = 0; tid < 3; ++tid) {
      for (std::size_t i = 0; i < sent.size(); i += 997) {
        sent[i] = static_cast<std::byte>(random());
      }
      const auto written = writer.write(sent, time_of(tid));
      ASSERT_TRUE(written) << written.error().message;
      EXPECT_EQ(*written, tid);
      SampleInfo info;
      for (;;) {
        ASSERT_EQ(reader.wait(kNever), WaitStatus::ready);
        const auto status = reader.read_next(received, info);
        ASSERT_TRUE(status) << status.error().message;
        if (*status == ReadStatus::ok) break;
      }
      EXPECT_EQ(info.tid, tid);
      EXPECT_EQ(info.time, time_of(tid));
      EXPECT_TRUE(received == sent);
      std::fill(received.begin(), received.end(), std::byte{});
      const auto read = reader.read_tid(tid, received, info);
      ASSERT_TRUE(read) << read.error().message;
      ASSERT_EQ(*read, ReadStatus::ok);
      EXPECT_TRUE(received == sent);
    }
    EXPECT_EQ(reader.lost_samples(), 0u);
  }
}

}  // namespace
}  // namespace dssm::test
