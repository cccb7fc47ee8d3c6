// SPDX-License-Identifier: Apache-2.0
//
// Readers of a stream that begins anew: told once, then on the new ring.
#include <gtest/gtest.h>
#include <poll.h>
#include <pthread.h>
#include <signal.h>

#include <atomic>
#include <dssm/dssm.hpp>
#include <future>
#include <memory>
#include <thread>

#include "core/wire/frame.hpp"
#include "tests/process/client/relay.hpp"
#include "tests/support/await.hpp"
#include "tests/support/daemon_process.hpp"
#include "tests/support/session.hpp"

namespace dssm {
namespace {

using namespace std::chrono_literals;
using test::await;
using test::DaemonProcess;

const StreamId kId{"anew", 0, ""};

// Removes the stream and creates it again.
Writer<double> recreate(Session& session) {
  session.remove(kId).value();
  return session.create<double>("anew", History{16, 1ms}).value();
}

// Waits for the next outcome of next() that is not not_yet.
ReadStatus next(Reader<double>& reader, double& value, SampleInfo& info) {
  for (;;) {
    const ReadStatus status = reader.read_next(value, info);
    if (status != ReadStatus::not_yet) return status;
    EXPECT_NE(reader.wait(kNever), WaitStatus::timeout);
  }
}

TEST(NewRing, IsGoneOnWithAfterTheOldOneIsReadToItsEnd) {
  const DaemonProcess daemon;
  Session session = connect(daemon);
  Writer<double> writer = session.create<double>("anew", History{16, 1ms}).value();
  Reader<double> reader = session.open_reader<double>("anew").value();
  reader.seek(kNoTid);
  for (int i = 0; i < 3; ++i) writer.write(i);
  const std::uint64_t old_ring = reader.incarnation();
  Writer<double> again = recreate(session);
  for (int i = 0; i < 2; ++i) again.write(100 + i);
  double value = 0;
  SampleInfo info;
  for (int i = 0; i < 3; ++i) {
    ASSERT_EQ(next(reader, value, info), ReadStatus::ok);
    EXPECT_EQ(info.tid, i);
    EXPECT_EQ(value, i);
  }
  ASSERT_EQ(next(reader, value, info), ReadStatus::restarted);
  EXPECT_EQ(value, 2) << "an outcome without a sample touches nothing";
  EXPECT_EQ(reader.cursor(), kNoTid);
  EXPECT_EQ(reader.restarts(), 1u);
  EXPECT_NE(reader.incarnation(), old_ring);
  EXPECT_EQ(reader.incarnation(), again.incarnation());
  for (int i = 0; i < 2; ++i) {
    ASSERT_EQ(next(reader, value, info), ReadStatus::ok);
    EXPECT_EQ(info.tid, i);
    EXPECT_EQ(value, 100 + i);
  }
  EXPECT_EQ(reader.read_next(value, info), ReadStatus::not_yet);
  EXPECT_EQ(reader.lost_samples(), 0u);
}

// What interrupt() runs in the thread that it interrupts: it stands still until released.
std::atomic<bool> interrupted, released;
void stand_still(int) {
  interrupted = true;
  while (!released) {
  }
}

// The last sample of the old ring comes, and then the new ring, at any moment of a read.
TEST(NewRing, IsFollowedOnlyAfterASampleThatCameDuringTheRead) {
  const DaemonProcess daemon;
  Session session = connect(daemon);
  Session other = connect(daemon);
  Writer<double> writer = other.create<double>("anew", History{16, 1ms}).value();
  Reader<double> reader = session.open_reader<double>("anew").value();
  reader.seek(kNoTid);
  struct sigaction before {};
  struct sigaction action {};
  action.sa_handler = stand_still;
  ASSERT_EQ(::sigaction(SIGUSR1, &action, &before), 0);
  const pthread_t reading = ::pthread_self();
  for (int round = 0; round < 100; ++round) {
    interrupted = released = false;
    std::jthread meanwhile([&] {
      Reader<double> last = session.open_reader<double>("anew").value();
      last.seek(kNoTid);
      ::pthread_kill(reading, SIGUSR1);
      await([] { return interrupted.load(); });
      writer.write(round);
      writer = recreate(other);
      double value = 0;
      SampleInfo info;
      EXPECT_EQ(next(last, value, info), ReadStatus::ok);
      // dssmd told the earlier reader first.
      EXPECT_EQ(next(last, value, info), ReadStatus::restarted);
      released = true;
    });
    double value = 0;
    SampleInfo info;
    ReadStatus status = ReadStatus::not_yet;
    while (status == ReadStatus::not_yet) status = reader.read_next(value, info);
    ASSERT_EQ(status, ReadStatus::ok) << "in round " << round;
    ASSERT_EQ(value, round);
    ASSERT_EQ(next(reader, value, info), ReadStatus::restarted);
  }
  ::sigaction(SIGUSR1, &before, nullptr);
}

TEST(NewRing, WakesReadersThatSleepOnTheOldOne) {
  const DaemonProcess daemon;
  Session session = connect(daemon);
  Writer<double> writer = session.create<double>("anew", History{16, 1ms}).value();
  Reader<double> reader = session.open_reader<double>("anew").value();
  const int ready = reader.ready_fd().value();
  std::thread sleeper([&] {
    double value = 0;
    SampleInfo info;
    ASSERT_EQ(next(reader, value, info), ReadStatus::restarted);
    ASSERT_EQ(next(reader, value, info), ReadStatus::ok);
    EXPECT_EQ(value, 7);
  });
  Writer<double> again = recreate(session);
  again.write(7);
  sleeper.join();
  pollfd event{ready, POLLIN, 0};
  ASSERT_EQ(::poll(&event, 1, -1), 1);
  reader.clear_ready();
  again.write(8);  // the descriptor speaks of the new ring
  ASSERT_EQ(::poll(&event, 1, -1), 1);
  double value = 0;
  SampleInfo info;
  ASSERT_EQ(reader.read_next(value, info), ReadStatus::ok);
  EXPECT_EQ(value, 8);
}

TEST(NewRing, IsReportedByReadsByTimeAtOnce) {
  const DaemonProcess daemon;
  Session session = connect(daemon);
  Writer<double> writer = session.create<double>("anew", History{16, 1ms}).value();
  writer.write(1, time_from_ns(1000));
  Reader<double> reader = session.open_reader<double>("anew").value();
  BorrowedSample borrowed;
  ASSERT_EQ(reader.borrow(0, borrowed), ReadStatus::ok);
  Writer<double> again = recreate(session);
  again.write(2, time_from_ns(2000));
  double value = 0;
  SampleInfo info;
  while (reader.read_at(time_from_ns(1500), value, info) != ReadStatus::restarted) {
    EXPECT_NE(reader.wait(kNever), WaitStatus::timeout);
  }
  EXPECT_EQ(Reader<double>::view(borrowed), 1) << "what was borrowed stays mapped";
  EXPECT_EQ(reader.read_at(time_from_ns(1500), value, info), ReadStatus::too_old);
  ASSERT_EQ(reader.read_at(time_from_ns(2500), value, info), ReadStatus::ok);
  EXPECT_EQ(value, 2);
}

TEST(NewRing, OfAnotherTypeLeavesTheReaderOnTheOldOneAndReportsWhy) {
  const DaemonProcess daemon;
  Session session = connect(daemon);
  Writer<double> writer = session.create<double>("anew", History{16, 1ms}).value();
  writer.write(1);
  Reader<double> reader = session.open_reader<double>("anew").value();
  session.remove(kId).value();
  RawWriter other = session.create_raw(kId, {"", 3, 1, {}}, History{16, 1ms}).value();
  double value = 0;
  SampleInfo info;
  while (!reader.restart_error()) {
    ASSERT_EQ(reader.read_newest(value, info), ReadStatus::ok);
    EXPECT_EQ(value, 1);
  }
  EXPECT_EQ(reader.restart_error()->code, Errc::type_mismatch);
  EXPECT_NE(reader.restart_error()->message.find("anew:0"), std::string::npos);
  EXPECT_EQ(reader.restarts(), 0u);
}

// While a program sets up its connection anew, dssmd may tell it already that a ring which it has
// just taken back has a successor: a mirror whose owner began anew.
TEST(NewRing, IsReportedDuringAReconnect) {
  const DaemonProcess daemon;
  Session writing = connect(daemon);
  test::Relay relay(daemon.socket_path());
  Session session = test::connect_to(relay.socket_path());
  std::vector<Writer<double>> writers;
  std::vector<Reader<double>> readers;
  for (const char* name : {"first", "last"}) {
    writers.push_back(writing.create<double>(name, History{16, 1ms}).value());
    readers.push_back(session.open_reader<double>(name).value());
  }
  std::atomic<int> notifications = 0;
  relay.set_behind([&notifications](const local::Response& response) {
    if (!response.has_opened()) return std::string();
    ++notifications;
    local::Response event;
    event.mutable_replaced()->set_handle(response.opened().handle());
    return wire::encode_frame(event);
  });
  relay.cut();
  await([&] { return notifications == 2; });
  relay.set_behind(nullptr);
  // Each asks for its new ring, again and again: there is none yet.
  double value = 0;
  SampleInfo info;
  for (Reader<double>& reader : readers) {
    const int before = relay.opens();
    for (const MonoTime end = deadline_in(30s); relay.opens() == before;) {
      ASSERT_LT(MonoClock::now(), end) << reader.id().str() << " does not know";
      EXPECT_EQ(reader.read_next(value, info), ReadStatus::not_yet);
    }
  }
}

// Has the relay notify the first program that opens a stream that it has a new ring.
void announce_new_ring(test::Relay& relay) {
  const auto notified = std::make_shared<std::atomic<bool>>(false);
  relay.set_behind([notified](const local::Response& response) {
    if (!response.has_opened() || notified->exchange(true)) return std::string();
    local::Response event;
    event.mutable_replaced()->set_handle(response.opened().handle());
    return wire::encode_frame(event);
  });
}

// An attempt to open the new ring may come too early: within the pause after one that failed, or
// while dssmd has none yet.
TEST(NewRing, KeepsAPollableDescriptorReadableUntilItIsOpened) {
  const DaemonProcess daemon;
  Session writing = connect(daemon);
  test::Relay relay(daemon.socket_path());
  Session session = test::connect_to(relay.socket_path());
  announce_new_ring(relay);
  Writer<double> writer = writing.create<double>("anew", History{16, 1ms}).value();
  Reader<double> reader = session.open_reader<double>("anew").value();
  pollfd event{reader.ready_fd().value(), POLLIN, 0};
  double value = 0;
  SampleInfo info;
  for (std::optional<Writer<double>> again;;) {
    ASSERT_EQ(::poll(&event, 1, -1), 1);
    reader.clear_ready();
    const ReadStatus status = reader.read_next(value, info);
    if (status == ReadStatus::restarted) break;
    ASSERT_EQ(status, ReadStatus::not_yet);
    if (!again && relay.opens() == 2) again = recreate(writing);  // it has tried in vain
  }
  EXPECT_EQ(reader.restarts(), 1u);
}

// Nobody has it then, and the reader must not stay in the list for ever.
TEST(LateAnswer, LeavesNoOpenStream) {
  const DaemonProcess daemon;
  Session writing = connect(daemon);
  const Writer<double> writer = writing.create<double>("late", History{16, 1ms}).value();
  const auto readers = [&] { return writing.stream_info({"late", 0, ""}).value().readers; };
  test::Relay relay(daemon.socket_path());
  Session impatient = test::connect_impatiently(relay.socket_path());
  std::promise<void> release;
  relay.set_behind([answer = release.get_future().share()](const local::Response& response) {
    if (response.has_opened()) answer.wait();
    return std::string();
  });
  EXPECT_FALSE(impatient.open_reader<double>("late"));
  await([&] { return readers() == 1; });
  release.set_value();
  await([&] { return readers() == 0; });
}

// After an attempt that found that there is no new ring, nothing is to be signalled.
TEST(NewRing, LeavesAPollableDescriptorQuietWhenThereIsNone) {
  const DaemonProcess daemon;
  test::Relay relay(daemon.socket_path());
  Session session = test::connect_to(relay.socket_path());
  announce_new_ring(relay);
  const Writer<double> writer = connect(daemon).create<double>("anew", History{16, 1ms}).value();
  Reader<double> reader = session.open_reader<double>("anew").value();
  pollfd event{reader.ready_fd().value(), POLLIN, 0};
  double value = 0;
  SampleInfo info;
  ASSERT_EQ(::poll(&event, 1, -1), 1);
  while (relay.opens() < 2) ASSERT_EQ(reader.read_next(value, info), ReadStatus::not_yet);
  reader.clear_ready();
  EXPECT_EQ(::poll(&event, 1, 1100), 0) << "it would be signalled once a second at least";
}

// A dssmd that died, and a writer that took the name before the reader's process was back: that
// process holds a ring that nobody else knows.
TEST(NewRing, IsFoundWhenTheNameWasTakenWhileDssmdWasDown) {
  DaemonProcess daemon({"--recovery-grace", "0 ms"});
  Session reading = connect(daemon);
  std::uint64_t restarts = 0;
  std::optional<Writer<double>> writer = reading.create<double>("anew", History{16, 1ms}).value();
  Reader<double> reader = reading.open_reader<double>("anew").value();
  double value = 0;
  SampleInfo info;
  // Whether the eager one comes first is a race; it is run until it did.
  while (restarts == 0) {
    writer.reset();
    daemon.kill_hard();
    daemon.start();
    Session eager = connect(daemon);
    writer = eager.create<double>("anew", History{16, 1ms}).value();
    writer->write(5);
    // A question that the reading session's keeper answers only when it is back and has offered.
    ASSERT_TRUE(reading.daemon_info());
    const bool took_the_name = writer->incarnation() != reader.incarnation();
    if (!took_the_name) continue;
    while (reader.read_newest(value, info) != ReadStatus::restarted) {
      EXPECT_NE(reader.wait(kNever), WaitStatus::timeout);
    }
    restarts = reader.restarts();
    ASSERT_EQ(reader.read_newest(value, info), ReadStatus::ok);
    EXPECT_EQ(value, 5);
    EXPECT_EQ(reader.incarnation(), writer->incarnation());
  }
}

}  // namespace
}  // namespace dssm
