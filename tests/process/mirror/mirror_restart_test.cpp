// SPDX-License-Identifier: Apache-2.0
//
// Mirrors in trouble: the owner's dssmd or the mirror's is killed, stopped or away, under load.
// What the owner's ring still holds when the link is back arrives, once and in order; what it does
// not hold is a gap of exactly that many samples.
#include <csignal>
#include <cstdio>
#include <cstdlib>
#include <future>

#include "tests/process/mirror/two_hosts.hpp"

namespace dssm::test {
namespace {

TEST_F(TwoHosts, LoseNothingWhenTheOwnersDaemonIsKilledUnderLoad) {
  auto writer = here.create<Numbered>("load", kLong).value();
  auto reader = open_filled<Numbered>(there, "load");
  ReaderThread reading(reader);
  std::int64_t written = 0;
  {
    WriterThread writing(writer);
    for (int round = 0; round < 5; ++round) {
      writing.await_more(100);
      pc1.kill_hard();
      writing.await_more(100);  // the writer goes on without a dssmd
      pc1.start();
      reading.await_taken(writing.written());
    }
    written = writing.stop();
  }
  reading.await_taken(written);
  EXPECT_EQ(reader.lost_samples(), 0u);
  EXPECT_EQ(reader.restarts(), 0u) << "the ring is the same";
  EXPECT_EQ(mirror("load").gap_samples, 0u);
  EXPECT_EQ(mirror("load").reconnects, 5u);
}

TEST_F(TwoHosts, LoseNothingWhenTheMirrorsDaemonIsKilledUnderLoad) {
  auto writer = here.create<Numbered>("load", kLong).value();
  auto reader = open_filled<Numbered>(there, "load");
  Session another = connect(pc2);
  auto second = open_filled<Numbered>(another, "load");
  ReaderThread reading(reader), reading_too(second);
  std::int64_t written = 0;
  {
    WriterThread writing(writer);
    for (int round = 0; round < 5; ++round) {
      writing.await_more(100);
      pc2.kill_hard();
      writing.await_more(100);
      pc2.start();
      reading.await_taken(writing.written());
    }
    written = writing.stop();
  }
  reading.await_taken(written);
  reading_too.await_taken(written);
  EXPECT_EQ(reader.lost_samples() + second.lost_samples(), 0u);
  EXPECT_EQ(reader.restarts() + second.restarts(), 0u);
  // One mirror serves them both, and new ones.
  auto later = open_filled<Numbered>(there, "load");
  EXPECT_EQ(later.incarnation(), writer.incarnation());
  EXPECT_EQ(channels("load"), 1u);
}

TEST_F(TwoHosts, LoseNothingWhenTheOwnersDaemonHangs) {
  auto writer = here.create<Numbered>("load", kLong).value();
  auto reader = open_filled<Numbered>(there, "load");
  ReaderThread reading(reader);
  WriterThread writing(writer);
  reading.await_taken(100);
  ::kill(pc1.pid(), SIGSTOP);
  // For long enough that its silence counts as death.
  await([&] { return mirror("load").state == MirrorState::owner_unavailable; });
  EXPECT_NE(mirror("load").error, "");
  const std::int64_t before = writing.written();
  ::kill(pc1.pid(), SIGCONT);
  reading.await_taken(before + 100);
  await([&] { return mirror("load").state == MirrorState::live; });
  EXPECT_EQ(mirror("load").error, "");
  reading.await_taken(writing.stop());
  EXPECT_EQ(reader.lost_samples(), 0u);
}

TEST_F(TwoHosts, KeepTheHistoryWhileTheOwnerIsUnavailable) {
  auto writer = here.create<Numbered>("kept", kLong).value();
  for (int i = 0; i < 100; ++i) writer.write(numbered(i));
  auto reader = open_filled<Numbered>(there, "kept");
  pc1.kill_hard();
  await([&] { return mirror("kept").state == MirrorState::owner_unavailable; });
  auto joined = there.open_reader<Numbered>("kept@pc1");
  ASSERT_TRUE(joined) << joined.error().message;
  Numbered sample{};
  SampleInfo info;
  for (Tid tid = 0; tid < 100; ++tid) {
    ASSERT_EQ(joined->read_tid(tid, sample, info), ReadStatus::ok);
    EXPECT_EQ(sample.number, tid);
  }
}

TEST_F(TwoHosts, FetchWhatWasWrittenMeanwhileOnlyWhileAProgramWantsItAtOnce) {
  auto writer = here.create<Numbered>("load", kLong).value();
  for (int i = 0; i < 100; ++i) writer.write(numbered(i));
  auto plain = there.await_reader<Numbered>("load", kNever).value();
  std::optional<Session> another = connect(pc2);
  auto reader =
      std::optional(another->open_reader<Numbered>("load", FetchHistory::at_once).value());
  const auto is_fetched = [&] {
    pc1.kill_hard();
    for (int i = 0; i < 10; ++i) writer.write(numbered(writer.newest_tid() + 1));
    pc1.start();
    EXPECT_EQ(plain.wait_for_sample(writer.newest_tid(), kNever), WaitStatus::ready);
    await([&] { return mirror("load").state == MirrorState::live; });
    return mirror("load").filling_samples == 0;
  };
  EXPECT_TRUE(is_fetched());
  reader.reset();
  another.reset();
  await([&] {
    const auto info = here.stream_info({"load", 0, ""});
    return info && info->readers == 1;
  });
  EXPECT_FALSE(is_fetched());
}

TEST_F(TwoHosts, CountExactlyWhatTheOwnersRingLostMeanwhile) {
  auto writer = here.create<Numbered>("short", History{64, 1ms}).value();
  auto reader = open_filled<Numbered>(there, "short");
  reader.seek(kNoTid);
  Numbered sample{};
  SampleInfo info;
  for (int i = 0; i < 10; ++i) writer.write(numbered(i));
  for (int i = 0; i < 10; ++i) {
    ASSERT_EQ(reader.wait(kNever), WaitStatus::ready);
    ASSERT_EQ(reader.read_next(sample, info), ReadStatus::ok);
  }
  pc1.kill_hard();
  await([&] { return mirror("short").state == MirrorState::owner_unavailable; });
  for (int i = 10; i < 1000; ++i) writer.write(numbered(i));
  const Tid oldest = 1000 - 63;
  pc1.start();
  for (Tid tid = oldest; tid < 1000; ++tid) {
    ASSERT_EQ(reader.wait(kNever), WaitStatus::ready);
    ASSERT_EQ(reader.read_next(sample, info), ReadStatus::ok);
    ASSERT_EQ(info.tid, tid);
    EXPECT_EQ(sample.number, tid);
  }
  EXPECT_EQ(reader.lost_samples(), static_cast<std::uint64_t>(oldest) - 10);
  EXPECT_EQ(mirror("short").gap_samples, static_cast<std::uint64_t>(oldest) - 10);
  EXPECT_EQ(reader.oldest_tid(), oldest);
}

// Its rings died with it: nobody held them.
TEST_F(TwoHosts, NotifyReadersThatTheOwnerRestartedWithoutItsRing) {
  auto reader = [&] {
    Session brief = connect(pc1);
    auto writer = brief.create<Numbered>("reborn", kLong).value();
    for (int i = 0; i < 10; ++i) writer.write(numbered(i));
    auto opened = open_filled<Numbered>(there, "reborn");
    EXPECT_EQ(opened.wait_for_tid(9, kNever), WaitStatus::ready);
    pc1.kill_hard();
    return opened;
  }();
  reader.seek(kNoTid);
  pc1.start();
  Session again = connect(pc1);
  auto writer = again.create<Numbered>("reborn", kLong).value();
  writer.write(numbered(100));
  Numbered sample{};
  SampleInfo info;
  for (int i = 0; i < 10; ++i) {
    ASSERT_EQ(reader.read_next(sample, info), ReadStatus::ok) << "first what the old ring held";
    EXPECT_EQ(sample.number, i);
  }
  ReadStatus status = ReadStatus::not_yet;
  await([&] { return (status = reader.read_next(sample, info)) != ReadStatus::not_yet; });
  EXPECT_EQ(status, ReadStatus::restarted);
  ASSERT_EQ(reader.wait(kNever), WaitStatus::ready);
  ASSERT_EQ(reader.read_next(sample, info), ReadStatus::ok);
  EXPECT_EQ(info.tid, 0);
  EXPECT_EQ(sample.number, 100);
  EXPECT_EQ(reader.incarnation(), writer.incarnation());
  EXPECT_EQ(mirror("reborn").restarts, 1u);
}

// Both at once: whoever comes back first waits for the other.
TEST_F(TwoHosts, FindEachOtherAgainWhenBothDaemonsAreKilled) {
  auto writer = here.create<Numbered>("load", kLong).value();
  auto reader = open_filled<Numbered>(there, "load");
  ReaderThread reading(reader);
  WriterThread writing(writer);
  for (int round = 0; round < 2; ++round) {
    writing.await_more(100);
    pc1.kill_hard();
    pc2.kill_hard();
    writing.await_more(100);
    (round == 0 ? pc1 : pc2).start();
    writing.await_more(100);
    (round == 0 ? pc2 : pc1).start();
    reading.await_taken(writing.written());
  }
  reading.await_taken(writing.stop());
  EXPECT_EQ(reader.lost_samples(), 0u);
  EXPECT_EQ(reader.restarts(), 0u);
}

// Somebody opens the stream before the program that holds its mirror has offered that: there is a
// new mirror then, and the program goes on with it, at the very sample it was.
TEST_F(TwoHosts, ContinueWithAMirrorThatWasMadeMeanwhile) {
  auto writer = here.create<Numbered>("load", kLong).value();
  int lines[2];
  ASSERT_EQ(::pipe2(lines, O_CLOEXEC), 0);
  const pid_t holder = start({built("client/dssmctl/dssmctl"), "echo", "--csv", "load@pc1"},
                             {pc2.environment()}, lines[1]);
  ::close(lines[1]);
  std::FILE* out = ::fdopen(lines[0], "r");
  char line[4096];
  ASSERT_TRUE(std::fgets(line, sizeof line, out)) << "the names of the columns";
  const auto expect_line = [&](std::int64_t tid) {
    ASSERT_TRUE(std::fgets(line, sizeof line, out));
    EXPECT_EQ(std::strtoll(line, nullptr, 10), tid) << line;
  };
  writer.write(numbered(0));
  expect_line(0);
  ::kill(holder, SIGSTOP);
  pc2.kill_hard();
  pc2.start();
  writer.write(numbered(1));
  await_state(there, pc1, HostState::up);
  auto eager = open_filled<Numbered>(there, "load@pc1");
  ::kill(holder, SIGCONT);
  expect_line(1);
  writer.write(numbered(2));
  expect_line(2);
  EXPECT_EQ(channels("load"), 1u);
  ::kill(holder, SIGKILL);
  wait_for(holder);
  std::fclose(out);
}

TEST_F(TwoHosts, WaitForAHostThatDoesNotAnswer) {
  auto writer = here.create<Numbered>("odometry", kLong).value();
  await_list(there, {"odometry:0@pc1"});
  ::kill(pc1.pid(), SIGSTOP);
  auto opened = std::async(std::launch::async, [this] {
    return there.await_reader<Numbered>("odometry@pc1", deadline_in(60s));
  });
  Session another = connect(pc2);  // the other one's questions wait for each other
  await([&] { return peer_at(another, pc1.address()).state == HostState::down; });
  ::kill(pc1.pid(), SIGCONT);
  const auto reader = opened.get();
  EXPECT_TRUE(reader) << reader.error().message;
}

TEST_F(TwoHosts, SayThatAHostDoesNotAnswer) {
  auto writer = here.create<Numbered>("odometry", kLong).value();
  await_list(there, {"odometry:0@pc1"});
  ::kill(pc1.pid(), SIGSTOP);
  const auto reader = there.open_reader<Numbered>("odometry");
  ::kill(pc1.pid(), SIGCONT);
  ASSERT_FALSE(reader);
  EXPECT_EQ(reader.error().code, Errc::unavailable);
  EXPECT_NE(reader.error().message.find("'pc1'"), std::string::npos) << reader.error().message;
}

}  // namespace
}  // namespace dssm::test
