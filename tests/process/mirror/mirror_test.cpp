// SPDX-License-Identifier: Apache-2.0
//
// Mirrors while all is well: they hold what the owner's ring holds, share one channel, come and go
// with their readers, and carry samples of every size.
#include <random>

#include "tests/process/mirror/two_hosts.hpp"
#include "tests/support/largest_payload.hpp"

namespace dssm::test {
namespace {

TEST_F(TwoHosts, ReadTheHistoryFromBeforeTheReaderCame) {
  auto writer = here.create<Numbered>("odometry", History{1024, 1ms}).value();
  for (int i = 0; i < 3000; ++i) writer.write(numbered(i), time_from_ns(1000 * i), Duration(i));
  auto reader = open_filled<Numbered>(there, "odometry");
  EXPECT_EQ(reader.id(), (StreamId{"odometry", 0, "pc1"}));
  EXPECT_EQ(reader.type(), type_of<Numbered>()) << "with all its fields";
  EXPECT_EQ(reader.depth(), 1024u);
  EXPECT_EQ(reader.cycle(), 1ms);
  EXPECT_EQ(reader.incarnation(), writer.incarnation());
  EXPECT_EQ(reader.newest_tid(), 2999);
  EXPECT_EQ(reader.oldest_tid(), here.open_reader<Numbered>("odometry").value().oldest_tid());
  for (Tid tid = reader.oldest_tid(); tid <= reader.newest_tid(); ++tid) {
    Numbered sample{};
    SampleInfo info;
    ASSERT_EQ(reader.read_tid(tid, sample, info), ReadStatus::ok);
    EXPECT_EQ(sample.number, tid);
    EXPECT_TRUE(is_whole(sample));
    EXPECT_EQ(to_ns(info.time), 1000 * tid);
    EXPECT_EQ(to_ns(info.clock_error), tid);
  }
  EXPECT_EQ(mirror("odometry").state, MirrorState::live);
  EXPECT_EQ(mirror("odometry").gap_samples, 0u);
}

TEST_F(TwoHosts, TakeNoMoreThanTheRateThatIsSetForAStream) {
  const DaemonProcess pc3({"--peer", pc1.address(), "--mirror-stream", "odo*=20 Hz"}, "pc3");
  Session slow = connect(pc3);
  await_state(slow, pc1, HostState::up);
  auto writer = here.create<Numbered>("odometry", History{1024, 1ms}).value();
  const auto write_to = [&](Tid last) {
    for (Tid tid = writer.newest_tid() + 1; tid <= last; ++tid) {
      writer.write(numbered(tid), time_from_ns(1000 * tid), Duration(1));
    }
  };
  write_to(99);
  auto reader = slow.await_reader<Numbered>("odometry", kNever).value();
  Numbered sample{};
  SampleInfo info;
  for (const Tid last : {149, 199}) {
    write_to(last);
    await([&] { return reader.newest_tid() == last; });
    ASSERT_EQ(reader.read_newest(sample, info), ReadStatus::ok);
    EXPECT_EQ(sample.number, last);
  }
  const auto mirror = [&] {
    return slow.stream_info({"odometry", 0, "pc1"}).value().mirror.value();
  };
  EXPECT_EQ(mirror().max_rate_hz, 20);
  EXPECT_LE(mirror().received_samples, 5u) << "99, 149, 199, and one of each burst";
  EXPECT_EQ(mirror().received_samples + mirror().gap_samples, 101u);
  // History is history: whole, but for what was left out since.
  EXPECT_EQ(reader.read_at(time_from_ns(50'000), sample, info), ReadStatus::arriving);
  await([&] { return mirror().filling_samples == 0; });
  for (Tid tid = 0; tid < 100; ++tid) EXPECT_EQ(reader.read_tid(tid, sample, info), ReadStatus::ok);
  EXPECT_EQ(reader.read_tid(140, sample, info), ReadStatus::lost);
}

TEST_F(TwoHosts, KeepNoMoreHistoryThanIsSetForAStream) {
  const DaemonProcess pc3({"--peer", pc1.address(), "--mirror-stream", "odo*=100 ms",
                           "--mirror-stream", "map=at_once, 5 ms"},
                          "pc3");
  Session small = connect(pc3);
  await_state(small, pc1, HostState::up);
  for (const char* name : {"odometry", "map"}) {
    auto writer = here.create<Numbered>(name, History{1024, 1ms}).value();
    const auto write_to = [&](Tid last) {
      for (Tid tid = writer.newest_tid() + 1; tid <= last; ++tid) {
        writer.write(numbered(tid), time_from_ns(1000 * tid), Duration(1));
      }
    };
    write_to(999);
    auto reader = small.await_reader<Numbered>(name, kNever).value();
    const Tid held = name == std::string("map") ? 5 : 100;
    EXPECT_EQ(reader.depth(), static_cast<std::uint64_t>(held) + 1);
    Numbered sample{};
    SampleInfo info;
    const auto mirror = [&] { return small.stream_info({name, 0, "pc1"}).value().mirror.value(); };
    for (const Tid last : {999, 1999}) {
      write_to(last);
      await([&] { return reader.newest_tid() == last; });
      EXPECT_EQ(reader.oldest_tid(), last - held + 1);
      // The first read of what is not here has it fetched.
      static_cast<void>(reader.read_tid(reader.oldest_tid(), sample, info));
      await([&] { return mirror().filling_samples == 0; });
      for (Tid tid = reader.oldest_tid(); tid <= last; ++tid) {
        ASSERT_EQ(reader.read_tid(tid, sample, info), ReadStatus::ok) << tid;
        EXPECT_EQ(sample.number, tid);
      }
      EXPECT_EQ(reader.read_tid(last - held, sample, info), ReadStatus::too_old);
    }
    EXPECT_EQ(mirror().state, MirrorState::live);
  }
}

TEST_F(TwoHosts, FetchTheHistoryWhenAProgramReadsIt) {
  auto writer = here.create<Numbered>("odometry", History{1024, 1ms}).value();
  for (int i = 0; i < 100; ++i) writer.write(numbered(i), time_from_ns(1000 * i), Duration(i));
  auto reader = there.await_reader<Numbered>("odometry", kNever).value();
  Numbered sample{};
  SampleInfo info;
  ASSERT_EQ(reader.read_newest(sample, info), ReadStatus::ok);
  for (int i = 100; i < 103; ++i) {
    writer.write(numbered(i), time_from_ns(1000 * i), Duration(i));
    ASSERT_EQ(reader.wait(kNever), WaitStatus::ready);
    ASSERT_EQ(reader.read_next(sample, info), ReadStatus::ok);
    EXPECT_EQ(info.tid, i);
  }
  EXPECT_EQ(mirror("odometry").state, MirrorState::live);
  EXPECT_EQ(mirror("odometry").received_samples, 4u) << "no program reads the others";
  EXPECT_EQ(mirror("odometry").filling_samples, 99u);
  EXPECT_FALSE(mirror("odometry").history_wanted);
  EXPECT_EQ(reader.oldest_tid(), 0);

  EXPECT_EQ(reader.read_at(time_from_ns(50'000), sample, info), ReadStatus::arriving);
  ASSERT_EQ(reader.wait_for_sample(50, kNever), WaitStatus::ready);
  await([&] { return mirror("odometry").filling_samples == 0; });
  ASSERT_EQ(reader.read_at(time_from_ns(50'000), sample, info), ReadStatus::ok);
  EXPECT_EQ(sample.number, 50);
  EXPECT_EQ(mirror("odometry").received_samples, 103u) << "each once";
}

TEST_F(TwoHosts, FetchTheHistoryForAnInOrderReaderThatSleeps) {
  auto writer = here.create<Numbered>("odometry", History{1024, 1ms}).value();
  for (int i = 0; i < 100; ++i) writer.write(numbered(i), time_from_ns(1000 * i), Duration(i));
  auto reader = there.await_reader<Numbered>("odometry", kNever).value();
  reader.seek(kNoTid);
  Numbered sample{};
  SampleInfo info;
  for (int i = 0; i < 100;) {
    const ReadStatus status = reader.read_next(sample, info);
    if (status == ReadStatus::not_yet) {
      ASSERT_EQ(reader.wait(kNever), WaitStatus::ready);
      continue;
    }
    ASSERT_EQ(status, ReadStatus::ok);
    ASSERT_EQ(sample.number, i++);
  }
  EXPECT_EQ(reader.lost_samples(), 0u);
}

TEST_F(TwoHosts, HaveTheHistoryAtOnceForAReaderThatAsksForIt) {
  auto writer = here.create<Numbered>("odometry", History{1024, 1ms}).value();
  for (int i = 0; i < 100; ++i) writer.write(numbered(i), time_from_ns(1000 * i), Duration(i));
  const auto first = there.await_reader<Numbered>("odometry", kNever).value();  // is live
  auto reader = there.open_reader<Numbered>("odometry", FetchHistory::at_once).value();
  Numbered sample{};
  SampleInfo info;
  ASSERT_EQ(reader.wait_for_sample(0, kNever), WaitStatus::ready);
  ASSERT_EQ(reader.read_tid(0, sample, info), ReadStatus::ok);
  EXPECT_TRUE(mirror("odometry").history_wanted);
}

// Also where times run backwards, and while the stream is written.
TEST_F(TwoHosts, AnswerReadsByTimeAsTheOwnerDoes) {
  const auto seed = std::random_device()();
  SCOPED_TRACE("seed " + std::to_string(seed));
  std::mt19937_64 random(seed);
  auto writer = here.create<Numbered>("jumpy", History{500, 1ms}).value();
  auto owned = here.open_reader<Numbered>("jumpy").value();
  auto mirrored = open_filled<Numbered>(there, "jumpy");
  std::int64_t time = 1'000'000;
  for (int i = 0; i < 5000; ++i) {
    time += random() % 50 == 0 ? -static_cast<std::int64_t>(random() % 5000)
                               : static_cast<std::int64_t>(random() % 20);
    writer.write(numbered(i), time_from_ns(time));
    if (i % 100 != 99) continue;
    ASSERT_EQ(mirrored.wait_for_tid(i, kNever), WaitStatus::ready);
    for (int reads = 0; reads < 100; ++reads) {
      const Time t = time_from_ns(time - 3000 + static_cast<std::int64_t>(random() % 4000));
      Numbered there_sample{}, here_sample{};
      SampleInfo there_info, here_info;
      const ReadStatus status = owned.read_at(t, here_sample, here_info);
      ASSERT_EQ(mirrored.read_at(t, there_sample, there_info), status);
      if (status != ReadStatus::ok) continue;
      ASSERT_EQ(there_info.tid, here_info.tid);
      ASSERT_EQ(there_info.time, here_info.time);
      ASSERT_EQ(there_sample.number, here_sample.number);
    }
  }
}

TEST_F(TwoHosts, ShareOneChannelAmongAllReaders) {
  auto writer = here.create<Numbered>("lidar", History{64, 1ms}).value();
  EXPECT_EQ(channels("lidar"), 0u);
  auto first = open_filled<Numbered>(there, "lidar");
  Session another = connect(pc2);
  auto second = open_filled<Numbered>(another, "lidar@pc1");
  auto third = open_filled<Numbered>(there, "lidar:0");
  EXPECT_EQ(channels("lidar"), 1u);
  writer.write(numbered(0));
  for (Reader<Numbered>* reader : {&first, &second, &third}) {
    EXPECT_EQ(reader->wait_for_tid(0, kNever), WaitStatus::ready);
  }
  EXPECT_EQ(channels("lidar"), 1u);
}

TEST_F(TwoHosts, ReadAnEmptyStreamFromItsFirstSampleOn) {
  auto writer = here.create<Numbered>("later", History{64, 1ms}).value();
  auto reader = open_filled<Numbered>(there, "later");
  EXPECT_EQ(reader.newest_tid(), kNoTid);
  EXPECT_EQ(mirror("later").state, MirrorState::live);
  writer.write(numbered(0));
  EXPECT_EQ(reader.wait_for_tid(0, kNever), WaitStatus::ready);
}

class LingeringHosts : public TwoHosts {
 protected:
  LingeringHosts() : TwoHosts("100 ms") {}
};

TEST_F(LingeringHosts, CloseTheChannelAfterTheLastReaderLeft) {
  auto writer = here.create<Numbered>("imu", History{64, 1ms}).value();
  const std::uint64_t memory = there.daemon_info().value().memory_bytes;
  for (int round = 0; round < 3; ++round) {
    {
      auto reader = open_filled<Numbered>(there, "imu");
      EXPECT_EQ(channels("imu"), 1u);
      EXPECT_GT(there.daemon_info().value().memory_bytes, memory);
    }
    await([&] { return channels("imu") == 0; });
    await([&] { return there.daemon_info().value().memory_bytes == memory; });
  }
}

// A program that is killed has left as well.
TEST_F(LingeringHosts, CloseTheChannelOfReadersThatDied) {
  auto writer = here.create<Numbered>("imu", History{64, 1ms}).value();
  writer.write(numbered(0));
  const int nowhere = ::open("/dev/null", O_WRONLY | O_CLOEXEC);
  const pid_t reader =
      start({built("client/dssmctl/dssmctl"), "echo", "imu@pc1"}, {pc2.environment()}, nowhere);
  ::close(nowhere);
  await([&] { return channels("imu") == 1; });
  ::kill(reader, SIGKILL);
  wait_for(reader);
  await([&] { return channels("imu") == 0; });
}

TEST_F(TwoHosts, FollowAStreamThatIsRecreated) {
  std::optional<Writer<Numbered>> writer = here.create<Numbered>("anew", History{64, 1ms}).value();
  for (int i = 0; i < 5; ++i) writer->write(numbered(i));
  auto reader = open_filled<Numbered>(there, "anew");
  reader.seek(kNoTid);
  ASSERT_TRUE(here.remove({"anew", 0, ""}));
  // The owner is asked, and says so.
  await([&] {
    const auto info = there.stream_info({"anew", 0, "pc1"});
    return !info && info.error().code == Errc::not_found;
  });
  const auto none = there.open_reader<Numbered>("anew@pc1");
  ASSERT_FALSE(none);
  EXPECT_EQ(none.error().code, Errc::not_found);
  Numbered sample{};
  SampleInfo info;
  for (int i = 0; i < 5; ++i) {
    ASSERT_EQ(reader.read_next(sample, info), ReadStatus::ok) << "what it had is still there";
    EXPECT_EQ(sample.number, i);
  }
  EXPECT_EQ(reader.read_next(sample, info), ReadStatus::not_yet);
  writer = here.create<Numbered>("anew", History{64, 1ms}).value();
  writer->write(numbered(100));
  ReadStatus status = ReadStatus::not_yet;
  await([&] { return (status = reader.read_next(sample, info)) != ReadStatus::not_yet; });
  EXPECT_EQ(status, ReadStatus::restarted);
  ASSERT_EQ(reader.wait(kNever), WaitStatus::ready);
  ASSERT_EQ(reader.read_next(sample, info), ReadStatus::ok);
  EXPECT_EQ(info.tid, 0);
  EXPECT_EQ(sample.number, 100);
  EXPECT_EQ(mirror("anew").restarts, 1u);
}

// --- sizes

TEST_F(TwoHosts, CarryTheLargestSamples) {
  constexpr std::size_t kBytes = kLargestPayloadBytes;
  const TypeInfo type{"", kBytes, 1, {}};
  auto writer = here.create_raw({"camera", 0, ""}, type, {3, 1s}).value();
  auto reader = there.open_raw_reader({"camera", 0, "pc1"}).value();
  std::vector<std::byte> payload(kBytes), got(kBytes);
  for (std::uint64_t tid = 0; tid < 3; ++tid) {
    for (std::size_t i = 0; i < kBytes; i += sizeof i) {
      const std::uint64_t word = (i + tid) * 0x9e3779b97f4a7c15;
      std::memcpy(&payload[i], &word, sizeof word);
    }
    ASSERT_EQ(writer.write(payload, time_from_ns(1)), static_cast<Tid>(tid));
    ASSERT_EQ(reader.wait_for_tid(static_cast<Tid>(tid), kNever), WaitStatus::ready);
    SampleInfo info;
    ASSERT_EQ(reader.read_tid(static_cast<Tid>(tid), got, info), ReadStatus::ok);
    ASSERT_TRUE(got == payload);
  }
  EXPECT_EQ(mirror("camera").gap_samples, 0u);
}

// Not more at once than a mirror on a slow machine can take without leaving some out.
TEST_F(TwoHosts, CarrySamplesOfOneByteInBursts) {
  constexpr Tid kSamples = 200'000, kBurst = 2'000;
  auto writer = here.create_raw({"bumper", 0, ""}, {"", 1, 1, {}}, {kSamples + 2, 10us}).value();
  auto reader = there.open_raw_reader({"bumper", 0, "pc1"}).value();
  reader.seek(kNoTid);
  for (Tid first = 0; first < kSamples; first += kBurst) {
    for (Tid tid = first; tid < first + kBurst; ++tid) {
      const auto byte = static_cast<std::byte>(tid * 7);
      writer.write({&byte, 1}, time_from_ns(tid));
    }
    for (Tid tid = first; tid < first + kBurst; ++tid) {
      std::byte byte{};
      SampleInfo info;
      ASSERT_EQ(reader.wait_for_sample(tid, kNever), WaitStatus::ready);
      ASSERT_EQ(reader.read_next({&byte, 1}, info), ReadStatus::ok);
      ASSERT_EQ(info.tid, tid);
      ASSERT_EQ(byte, static_cast<std::byte>(tid * 7));
    }
  }
  EXPECT_EQ(mirror("bumper").gap_samples, 0u);
  EXPECT_EQ(mirror("bumper").received_samples, static_cast<std::uint64_t>(kSamples));
}

// --- limits

TEST(TightHosts, SayWhichLimitAMirrorWouldBreak) {
  DaemonProcess pc1({}, "pc1");
  DaemonProcess pc2({"--peer", pc1.address(), "--max-memory", "1 MiB", "--max-streams", "2"},
                    "pc2");
  Session here = connect(pc1), there = connect(pc2);
  await_state(there, pc1, HostState::up);
  auto big = here.create<Numbered>("big", History{1 << 16, 1ms}).value();
  auto small = here.create<Numbered>("small", History{16, 1ms}).value();
  auto more = here.create<Numbered>("more", History{16, 1ms}).value();
  const auto refused = there.open_reader<Numbered>("big@pc1");
  ASSERT_FALSE(refused);
  EXPECT_EQ(refused.error().code, Errc::limit_exceeded);
  EXPECT_NE(refused.error().message.find("max_memory"), std::string::npos)
      << refused.error().message;
  auto own = there.create<Numbered>("own", History{16, 1ms}).value();
  auto mirrored = open_filled<Numbered>(there, "small@pc1");
  const auto third = there.open_reader<Numbered>("more@pc1");
  ASSERT_FALSE(third);
  EXPECT_NE(third.error().message.find("max_streams"), std::string::npos) << third.error().message;
}

}  // namespace
}  // namespace dssm::test
