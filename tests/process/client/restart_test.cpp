// SPDX-License-Identifier: Apache-2.0
//
// dssmd killed and started again under load: readers and writers go on in their rings, offer them
// back, and not one sample is lost, torn or delivered twice.
#include <fcntl.h>
#include <gtest/gtest.h>
#include <unistd.h>

#include <atomic>
#include <csignal>
#include <dssm/dssm.hpp>
#include <fstream>
#include <future>
#include <optional>
#include <thread>

#include "tests/support/await.hpp"
#include "tests/support/daemon_process.hpp"
#include "tests/support/folder.hpp"
#include "tests/support/samples.hpp"
#include "tests/support/session.hpp"

namespace dssm {
namespace {

using namespace std::chrono_literals;
using test::await;
using test::DaemonProcess;
using test::Numbered;
using test::numbered;
using test::ReaderThread;
using test::WriterThread;

TEST(Restart, LosesNoSampleWhenTheDaemonIsKilledUnderLoad) {
  DaemonProcess daemon;
  Session writing = connect(daemon), reading = connect(daemon);
  Writer<Numbered> writer = writing.create<Numbered>("load", History{1 << 16, 1ms}).value();
  Reader<Numbered> reader = reading.open_reader<Numbered>("load").value();
  const std::uint64_t incarnation = writer.incarnation();
  WriterThread writer_thread(writer);
  const ReaderThread reader_thread(reader);
  for (int round = 0; round < 5; ++round) {
    daemon.kill_hard();
    writer_thread.await_more(100);  // without dssmd
    daemon.start();
    // Both sessions are back with what they hold, under the same ring.
    const StreamInfo info = [&] {
      for (;;) {
        auto seen = reading.stream_info({"load", 0, ""});
        if (seen && seen->writers == 1 && seen->readers == 1) return *seen;
        std::this_thread::sleep_for(test::kPollPause);
      }
    }();
    EXPECT_EQ(info.incarnation, incarnation);
    EXPECT_EQ(info.type, type_of<Numbered>()) << "the description came back as well";
    EXPECT_EQ(info.creator_pid, ::getpid());
  }
  // New readers and writers join the old ring.
  Session later = connect(daemon);
  EXPECT_EQ(later.open_reader<Numbered>("load").value().incarnation(), incarnation);
  EXPECT_EQ(later.create<Numbered>("load", History{16, 1ms}).value().incarnation(), incarnation);
  reader_thread.await_taken(writer_thread.stop());
  EXPECT_EQ(reader.lost_samples(), 0u);
}

TEST(Restart, BringsBackAStreamThatOnlyReadersHold) {
  DaemonProcess daemon;
  Session session = connect(daemon);
  {
    Writer<Numbered> writer = session.create<Numbered>("kept", History{16, 1ms}).value();
    writer.write(numbered(0));
    ASSERT_TRUE(writer.set_property(std::vector<std::byte>(1000, std::byte{7})));
  }
  // Opened before the writer is closed in dssmd's order of requests, so it is there to be kept.
  Reader<Numbered> reader = session.open_reader<Numbered>("kept").value();
  daemon.kill_hard();
  daemon.start();
  auto writer = session.open_writer<Numbered>("kept");
  ASSERT_TRUE(writer) << writer.error().message;
  EXPECT_EQ(writer->write(numbered(1)), 1);
  EXPECT_EQ(reader.newest_tid(), 1);
  EXPECT_EQ(session.property({"kept", 0, ""}).value(), std::vector<std::byte>(1000, std::byte{7}));
}

// The name is kept free for the ring that a living process is about to offer back.
TEST(Restart, DoesNotLetAnEagerWriterReplaceAHeldRing) {
  DaemonProcess daemon(test::kPatientRecovery);
  Session holding = connect(daemon);
  Writer<Numbered> writer = holding.create<Numbered>("held", History{16, 1ms}).value();
  for (int round = 0; round < 5; ++round) {
    daemon.kill_hard();
    daemon.start();
    Session eager = connect(daemon);  // usually there before the holder is back
    auto again = eager.create<Numbered>("held", History{16, 1ms});
    ASSERT_TRUE(again) << again.error().message;
    EXPECT_EQ(again->incarnation(), writer.incarnation());
  }
}

TEST(Restart, ForgetsStreamsThatNoProgramHolds) {
  DaemonProcess daemon;
  Session session = connect(daemon);
  session.create<Numbered>("gone", History{16, 1ms}).value();
  ASSERT_EQ(session.list_streams().value().size(), 1u);
  daemon.kill_hard();
  daemon.start();
  EXPECT_EQ(session.list_streams().value().size(), 0u);
}

TEST(Restart, KeepsThePlaybackClock) {
  DaemonProcess daemon;
  Session session = connect(daemon);
  PlaybackClock clock = session.open_playback_clock().value();
  clock.set_paused(true);
  clock.set_time(1234);
  daemon.kill_hard();
  daemon.start();
  ASSERT_TRUE(session.list_streams());  // back, and what it held offered
  EXPECT_EQ(connect(daemon).open_playback_clock().value().now_s(), 1234);
}

TEST(Restart, NotifiesWatchersOfRemovedStreams) {
  DaemonProcess daemon;
  Session session = connect(daemon), other = connect(daemon);
  std::mutex mutex;
  std::condition_variable changed;
  std::vector<std::string> seen;
  auto watch = session.watch([&](const StreamEvent& event) {
    const std::lock_guard guard(mutex);
    seen.push_back((event.kind == StreamEvent::Kind::added ? "+" : "-") + event.stream.id.name);
    changed.notify_all();
  });
  ASSERT_TRUE(watch);
  auto kept = session.create<Numbered>("kept", History{16, 1ms}).value();
  other.create<Numbered>("gone", History{16, 1ms}).value();
  std::unique_lock lock(mutex);
  changed.wait(lock, [&] { return seen.size() == 2; });
  lock.unlock();
  daemon.kill_hard();
  daemon.start();
  lock.lock();
  changed.wait(lock, [&] { return seen.size() >= 3; });
  lock.unlock();
  // Nothing else was said: the next thing is the next thing that happens.
  other.create<Numbered>("marker", History{16, 1ms}).value();
  lock.lock();
  changed.wait(lock, [&] { return seen.back() == "+marker"; });
  EXPECT_EQ(seen, (std::vector<std::string>{"+kept", "+gone", "-gone", "+marker"}));
}

// Two watches that are made at once share a request: when that fails, the one that was made first
// fails, and the other one counts on the next dssmd.
TEST(Restart, NotifiesAWatchThatWasMadeWhileAnotherOneWaited) {
  DaemonProcess daemon;
  Session other = connect(daemon);
  Session impatient = test::connect_impatiently(daemon.socket_path());
  daemon.kill_hard();
  std::atomic<bool> heard{false};
  const auto watch = [&] {
    return impatient.watch([&](const StreamEvent& event) {
      if (event.stream.id.name == "marker") heard = true;
    });
  };
  std::optional<Session::Watch> watching;
  await([&] {
    auto another = std::async(std::launch::async, watch);
    auto one = watch(), two = another.get();
    if (one.has_value() == two.has_value()) return false;  // one after the other
    watching = one ? *std::move(one) : *std::move(two);
    return true;
  });
  daemon.start();
  const auto marker = other.create<Numbered>("marker", History{16, 1ms}).value();
  await([&] { return heard.load(); });
}

// As after a change of the configuration.
TEST(Restart, ReadersGoOnThatTheNextDaemonHasNoPlaceForAtFirst) {
  const test::TestFolder folder;
  const auto configure = [&](const char* text) {
    std::ofstream(folder.file("dssmd.conf")) << text << '\n';
  };
  configure("");
  DaemonProcess daemon({"--config", folder.file("dssmd.conf"), "--listen", ""});
  Session session = connect(daemon);
  Writer<Numbered> writer = session.create<Numbered>("s", History{16, 1ms}).value();
  Reader<Numbered> reader = session.open_reader<Numbered>("s").value();
  daemon.kill_hard();
  configure("max_opens = 1");  // it is the writer's, which is offered first
  daemon.start();
  const auto users = [&] {
    const auto info = session.stream_info({"s", 0, ""});
    return info ? std::pair(info->writers, info->readers) : std::pair(0U, 0U);
  };
  await([&] { return users() == std::pair(1U, 0U); });
  configure("max_opens = 8");
  ASSERT_EQ(::kill(daemon.pid(), SIGHUP), 0);
  await([&] {
    static_cast<void>(reader.read_next());
    return users() == std::pair(1U, 1U);
  });
}

TEST(Restart, FailsRequestsWithAReasonWhileTheDaemonIsDown) {
  DaemonProcess daemon;
  Session session = connect(daemon);
  Writer<Numbered> writer = session.create<Numbered>("s", History{16, 1ms}).value();
  Session impatient = test::connect_impatiently(daemon.socket_path());
  daemon.kill_hard();
  const auto list = impatient.list_streams();
  ASSERT_FALSE(list);
  EXPECT_EQ(list.error().code, Errc::unavailable);
  EXPECT_NE(list.error().message.find("list the streams"), std::string::npos);
  EXPECT_EQ(writer.write(numbered(0)), 0) << "writing needs no daemon";
}

// Clients die at any moment; a second later dssmd has nothing left of them.
TEST(Restart, DaemonKeepsNothingOfClientsThatWereKilled) {
  DaemonProcess daemon;
  Session session = connect(daemon);
  for (int round = 0; round < 50; ++round) {
    int started[2];
    ASSERT_EQ(::pipe2(started, O_CLOEXEC), 0);
    const pid_t victim =
        test::start({test::built("tests/process/client/victim"), std::to_string(round % 7)},
                    {daemon.environment()}, started[1]);
    ::close(started[1]);
    char byte = 0;
    ASSERT_EQ(::read(started[0], &byte, 1), 1) << "it ended by itself";
    ::kill(victim, SIGKILL);
    test::wait_for(victim);
    ::close(started[0]);
  }
  // Its sockets are closed by the kernel before its death is reported; dssmd has them on its loop.
  await([&] { return session.list_clients().value().size() == 1; });
  EXPECT_EQ(session.list_opens().value().size(), 0u);
  for (const StreamInfo& stream : session.list_streams().value()) {
    auto writer = session.open_raw_writer(stream.id);
    ASSERT_TRUE(writer) << writer.error().message;
    EXPECT_EQ(writer->write(std::vector<std::byte>(128), Time()), stream.newest + 1)
        << "and its lock is free";
  }
}

}  // namespace
}  // namespace dssm
