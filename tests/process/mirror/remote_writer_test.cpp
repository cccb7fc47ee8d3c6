// SPDX-License-Identifier: Apache-2.0
//
// Writing into the stream of another host: each sample arrives once, in order, whatever happens to
// the link and to either dssmd in between.
#include <csignal>

#include "tests/process/mirror/two_hosts.hpp"

namespace dssm::test {
namespace {

// pc2 writes, pc1 owns and reads.
struct RemoteWriter : TwoHosts {
  RemoteWriter() : TwoHosts("5 s", kPatientRecovery) {}
};

TEST_F(RemoteWriter, CreatesTheStreamAndWritesWithTheOwnersTids) {
  auto writer = there.create<Numbered>("goal@pc1", kLong).value();
  EXPECT_EQ(writer.id(), (StreamId{"goal", 0, "pc1"}));
  auto reader = here.open_reader<Numbered>("goal").value();
  EXPECT_EQ(reader.type(), type_of<Numbered>());
  EXPECT_EQ(reader.depth(), kLong.depth);
  EXPECT_EQ(reader.cycle(), kLong.cycle);
  for (int i = 0; i < 10; ++i) {
    EXPECT_EQ(writer.write(numbered(i), time_from_ns(i), Duration(2 * i)), i);
    ASSERT_EQ(reader.wait_for_tid(i, kNever), WaitStatus::ready);
    Numbered sample{};
    SampleInfo info;
    ASSERT_EQ(reader.read_tid(i, sample, info), ReadStatus::ok);
    EXPECT_EQ(sample.number, i);
    EXPECT_EQ(to_ns(info.time), i);
    EXPECT_EQ(to_ns(info.clock_error), 2 * i);
  }
  EXPECT_EQ(names(there.list_own_streams().value()), std::vector<std::string>{});
}

TEST_F(RemoteWriter, ContinuesTheTidsOfAnExistingStream) {
  auto first = here.create<Numbered>("goal", kLong).value();
  for (int i = 0; i < 7; ++i) first.write(numbered(i));
  auto writer = there.open_writer<Numbered>("goal@pc1").value();
  EXPECT_EQ(writer.write(numbered(7)), 7);
  auto joined = there.create<Numbered>("goal@pc1", kLong).value();
  EXPECT_EQ(joined.write(numbered(8)), 8) << "all writers of a PC share one ring";
  auto reader = here.open_reader<Numbered>("goal").value();
  ASSERT_EQ(reader.wait_for_tid(8, kNever), WaitStatus::ready);
  EXPECT_EQ(channels("goal"), 1u);
  const auto longer = there.create<Numbered>("goal@pc1", History{kLong.depth + 1, kLong.cycle});
  ASSERT_FALSE(longer);
  EXPECT_EQ(longer.error().code, Errc::conflict) << longer.error().message;
}

TEST_F(RemoteWriter, IsReadOnItsOwnPcAsOnAnyOther) {
  auto writer = there.create<Numbered>("goal@pc1", kLong).value();
  auto reader = there.open_reader<Numbered>("goal@pc1").value();
  writer.write(numbered(0));
  EXPECT_EQ(reader.wait_for_tid(0, kNever), WaitStatus::ready);
}

TEST_F(RemoteWriter, IsRefusedWithAReason) {
  auto other = here.create<double>("goal", kLong).value();
  const auto mismatch = there.create<Numbered>("goal@pc1", kLong);
  ASSERT_FALSE(mismatch);
  EXPECT_EQ(mismatch.error().code, Errc::type_mismatch);
  const auto missing = there.open_writer<Numbered>("missing@pc1");
  ASSERT_FALSE(missing);
  EXPECT_EQ(missing.error().code, Errc::not_found);
  const auto nowhere = there.create<Numbered>("goal@pc9", kLong);
  ASSERT_FALSE(nowhere);
  EXPECT_EQ(nowhere.error().code, Errc::not_found);
  EXPECT_EQ(there.daemon_info().value().memory_bytes, 0u);
}

TEST_F(RemoteWriter, CatchesUpWhenTheOwnersDaemonWasKilled) {
  auto writer = there.create<Numbered>("goal@pc1", kLong).value();
  auto reader = here.open_reader<Numbered>("goal").value();  // keeps the ring
  ReaderThread reading(reader);
  WriterThread writing(writer);
  for (int round = 0; round < 5; ++round) {
    writing.await_more(100);
    pc1.kill_hard();
    writing.await_more(100);
    pc1.start();
    reading.await_taken(writing.written());
  }
  reading.await_taken(writing.stop());
  EXPECT_EQ(reader.newest_tid(), writing.written() - 1) << "none twice";
  EXPECT_EQ(reader.lost_samples(), 0u);
}

// Much more is under way, and written, than was acknowledged.
TEST_F(RemoteWriter, CatchesUpWhenTheOwnersDaemonIsKilledInTheMidstOfABacklog) {
  constexpr std::int64_t kBacklog = 15'000;
  auto writer = there.create<Numbered>("goal@pc1", kLong).value();
  auto reader = here.open_reader<Numbered>("goal").value();
  ReaderThread reading(reader);
  std::int64_t written = 0;
  for (int round = 0; round < 5; ++round) {
    ::kill(pc1.pid(), SIGSTOP);
    for (std::int64_t i = 0; i < kBacklog; ++i) writer.write(numbered(written++));
    const Tid before = reader.newest_tid();
    ::kill(pc1.pid(), SIGCONT);
    await([&] { return reader.newest_tid() > before + 1000 * (round + 1); });
    pc1.kill_hard();
    pc1.start();
    reading.await_taken(written);
  }
  EXPECT_EQ(reader.newest_tid(), written - 1) << "none twice";
  EXPECT_EQ(reader.lost_samples(), 0u);
}

TEST_F(RemoteWriter, CatchesUpWhenItsOwnDaemonWasKilled) {
  auto writer = there.create<Numbered>("goal@pc1", kLong).value();
  auto reader = here.open_reader<Numbered>("goal").value();
  ReaderThread reading(reader);
  WriterThread writing(writer);
  for (int round = 0; round < 5; ++round) {
    writing.await_more(100);
    pc2.kill_hard();
    writing.await_more(100);
    pc2.start();
    reading.await_taken(writing.written());
  }
  reading.await_taken(writing.stop());
  EXPECT_EQ(reader.newest_tid(), writing.written() - 1);
  EXPECT_EQ(reader.lost_samples(), 0u);
}

TEST_F(RemoteWriter, CatchesUpWhenTheOwnersDaemonHangs) {
  auto writer = there.create<Numbered>("goal@pc1", kLong).value();
  auto reader = here.open_reader<Numbered>("goal").value();
  ReaderThread reading(reader);
  WriterThread writing(writer);
  reading.await_taken(100);
  ::kill(pc1.pid(), SIGSTOP);
  await_state(there, pc1, HostState::down);
  ::kill(pc1.pid(), SIGCONT);
  reading.await_taken(writing.written() + 100);
  reading.await_taken(writing.stop());
  EXPECT_EQ(reader.newest_tid(), writing.written() - 1);
}

TEST_F(RemoteWriter, CreatesTheStreamAgainWhenTheOwnerLostIt) {
  auto writer = there.create<Numbered>("goal@pc1", kLong).value();
  writer.write(numbered(0));
  await([&] { return here.stream_info({"goal", 0, ""}).value().newest == 0; });
  pc1.kill_hard();
  pc1.start();
  writer.write(numbered(1));
  Reader<Numbered> reader = here.await_reader<Numbered>("goal").value();
  ASSERT_EQ(reader.wait(kNever), WaitStatus::ready);
  Numbered sample{};
  SampleInfo info;
  ASSERT_EQ(reader.read_newest(sample, info), ReadStatus::ok);
  EXPECT_EQ(sample.number, 1);
}

TEST_F(RemoteWriter, PublishesTheRestAfterItsProgramHasGone) {
  {
    auto writer = there.create<Numbered>("goal@pc1", kLong).value();
    ::kill(pc1.pid(), SIGSTOP);
    for (int i = 0; i < 1000; ++i) writer.write(numbered(i));
  }
  ::kill(pc1.pid(), SIGCONT);
  auto reader = here.open_reader<Numbered>("goal").value();
  ReaderThread reading(reader);
  reading.await_taken(1000);
  await([&] { return there.daemon_info().value().memory_bytes == 0; });
  EXPECT_EQ(reader.newest_tid(), 999);
}

TEST_F(RemoteWriter, CarriesLargeSamples) {
  constexpr std::size_t kBytes = 16U << 20;
  auto writer = there.create_raw({"camera", 0, "pc1"}, {"", kBytes, 1, {}}, {3, 1s}).value();
  auto reader = here.open_raw_reader({"camera", 0, ""}).value();
  std::vector<std::byte> got(kBytes);
  for (Tid tid = 0; tid < 4; ++tid) {
    const std::vector<std::byte> payload(kBytes, static_cast<std::byte>(tid + 1));
    ASSERT_EQ(writer.write(payload, time_from_ns(1)), tid);
    ASSERT_EQ(reader.wait_for_tid(tid, kNever), WaitStatus::ready);
    SampleInfo info;
    ASSERT_EQ(reader.read_tid(tid, got, info), ReadStatus::ok);
    ASSERT_TRUE(got == payload);
  }
}

}  // namespace
}  // namespace dssm::test
