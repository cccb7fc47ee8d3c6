// SPDX-License-Identifier: Apache-2.0
//
// libdssm's public API against a real dssmd, as a user's program would use it.
#include <gtest/gtest.h>
#include <poll.h>
#include <sys/resource.h>
#include <sys/wait.h>

#include <array>
#include <dssm/dssm.hpp>
#include <filesystem>
#include <set>
#include <thread>

#include "tests/support/daemon_process.hpp"
#include "tests/support/session.hpp"
#include "tests/support/signals.hpp"

namespace dssm {
namespace {

using namespace std::chrono_literals;
using test::DaemonProcess;
using test::SeenEvents;

struct Odometry {
  double x, y, theta;
};
DSSM_DESCRIBE(Odometry, x, y, theta)

struct Turned {  // same size, other type
  double a, b, c;
};

struct Api : testing::Test {
  DaemonProcess daemon;
  Session session = test::connect(daemon);

  Writer<Odometry> make(std::string_view name = "odometry", History history = {64, 10ms}) {
    return session.create<Odometry>(name, history).value();
  }
};

// The sample written as number `tid`: its time is 100 ms * tid.
Odometry sample(Tid tid) { return {1.0 * static_cast<double>(tid), -1, 0.5}; }
Time time_of(Tid tid) { return time_from_ns(tid * 100'000'000); }

void write(Writer<Odometry>& writer, Tid tid) {
  ASSERT_EQ(writer.write(sample(tid), time_of(tid)), tid);
}

TEST_F(Api, ReadsByTidByTimeAndInOrder) {
  auto writer = make();
  auto reader = session.open_reader<Odometry>("odometry").value();
  Odometry out{};
  SampleInfo info;
  EXPECT_EQ(reader.read_newest(out, info), ReadStatus::not_yet);
  EXPECT_EQ(reader.read_next(out, info), ReadStatus::not_yet);
  EXPECT_EQ(reader.read_at(time_of(1), out, info), ReadStatus::not_yet);
  for (Tid tid = 0; tid < 10; ++tid) write(writer, tid);

  ASSERT_EQ(reader.read_next(out, info), ReadStatus::ok) << "a fresh reader begins with the newest";
  EXPECT_EQ(info.tid, 9);
  EXPECT_EQ(reader.read_next(out, info), ReadStatus::not_yet);
  EXPECT_EQ(info.tid, 9) << "arguments stay as they were";
  write(writer, 10);
  ASSERT_EQ(reader.read_next(out, info), ReadStatus::ok);
  EXPECT_EQ(info.tid, 10);
  ASSERT_EQ(reader.read_previous(out, info), ReadStatus::ok);
  EXPECT_EQ(info.tid, 9);
  ASSERT_EQ(reader.read_tid(3, out, info), ReadStatus::ok);
  EXPECT_EQ(out.x, 3);
  EXPECT_EQ(info.time, time_of(3));
  ASSERT_EQ(reader.read_at(time_of(5) + 1ms, out, info), ReadStatus::ok);
  EXPECT_EQ(info.tid, 5);
  ASSERT_EQ(reader.read_at(time_of(5), out, info), ReadStatus::ok);
  EXPECT_EQ(info.tid, 5);
  ASSERT_EQ(reader.read_at(time_of(500), out, info), ReadStatus::ok);
  EXPECT_EQ(info.tid, 10);
  EXPECT_EQ(reader.read_at(time_of(0) - 1ns, out, info), ReadStatus::too_old);
  ASSERT_EQ(reader.read_at_or_after(time_of(5) + 1ns, out, info), ReadStatus::ok);
  EXPECT_EQ(info.tid, 6);
  ASSERT_EQ(reader.read_at_or_after(time_of(5), out, info), ReadStatus::ok);
  EXPECT_EQ(info.tid, 5);
  ASSERT_EQ(reader.read_at_or_after(time_of(-5), out, info), ReadStatus::ok);
  EXPECT_EQ(info.tid, 0);
  EXPECT_EQ(reader.read_at_or_after(time_of(10) + 1ns, out, info), ReadStatus::not_yet);
  ASSERT_EQ(reader.read_nearest(time_of(5) + 50ms, out, info), ReadStatus::ok);
  EXPECT_EQ(info.tid, 5) << "the earlier one of two equally close ones";
  ASSERT_EQ(reader.read_nearest(time_of(5) + 51ms, out, info), ReadStatus::ok);
  EXPECT_EQ(info.tid, 6);
  ASSERT_EQ(reader.read_nearest(time_of(-3), out, info), ReadStatus::ok);
  EXPECT_EQ(info.tid, 0);
  ASSERT_EQ(reader.read_nearest(time_of(33), out, info), ReadStatus::ok);
  EXPECT_EQ(info.tid, 10);
  Neighbours around;
  ASSERT_EQ(reader.find_neighbours(time_of(5) + 30ms, around), ReadStatus::ok);
  EXPECT_EQ(around.before.tid, 5);
  EXPECT_EQ(around.after.tid, 6);
  EXPECT_EQ(reader.find_neighbours(time_of(10), around), ReadStatus::not_yet);
  EXPECT_EQ(reader.find_neighbours(time_of(0) - 1ns, around), ReadStatus::too_old);
}

TEST_F(Api, ReadsSeveralStreamsAtOneTimeOrNone) {
  auto odometry = make();
  auto rough = make("rough");
  make("empty");
  for (Tid tid = 0; tid < 4; ++tid) write(odometry, tid);
  for (Tid tid = 0; tid < 2; ++tid) write(rough, tid);
  auto reader = session.open_reader<Odometry>("odometry").value();
  auto rough_reader = session.open_reader<Odometry>("rough").value();
  auto empty_reader = session.open_reader<Odometry>("empty").value();
  Odometry out{}, rough_out{}, empty_out{};
  std::array samples{reader.joint_sample(out), rough_reader.joint_sample(rough_out)};
  JointRead read = read_joint_at(time_of(2), samples, 0ns);
  EXPECT_EQ(read.status, ReadStatus::ok);
  EXPECT_EQ(read.clock_error, 0ns) << "both are of this PC's clock";
  EXPECT_EQ(samples[0].info.tid, 2);
  EXPECT_EQ(out.x, sample(2).x);
  EXPECT_EQ(samples[1].info.tid, 1);
  EXPECT_EQ(rough_out.x, sample(1).x);

  EXPECT_EQ(read_joint_at(time_of(0) - 1ns, samples).status, ReadStatus::too_old);
  std::array three{reader.joint_sample(out), rough_reader.joint_sample(rough_out),
                   empty_reader.joint_sample(empty_out)};
  read = read_joint_at(time_of(3), three);
  EXPECT_EQ(read.status, ReadStatus::not_yet);
  EXPECT_EQ(read.index, 2U);
}

TEST_F(Api, CountsWhatAReaderLostWhenItWasLapped) {
  auto writer = make("odometry", {8, 10ms});
  auto reader = session.open_reader<Odometry>("odometry").value();
  Odometry out{};
  SampleInfo info;
  write(writer, 0);
  ASSERT_EQ(reader.read_next(out, info), ReadStatus::ok);
  for (Tid tid = 1; tid <= 20; ++tid) write(writer, tid);
  ASSERT_EQ(reader.read_next(out, info), ReadStatus::ok);
  EXPECT_EQ(info.tid, 14) << "8 slots hold 7 samples";
  EXPECT_EQ(reader.lost_samples(), 13u);
  for (Tid tid = 15; tid <= 20; ++tid) {
    ASSERT_EQ(reader.read_next(out, info), ReadStatus::ok);
    EXPECT_EQ(info.tid, tid);
  }
  EXPECT_EQ(reader.lost_samples(), 13u);
  reader.seek(kNoTid);
  ASSERT_EQ(reader.read_next(out, info), ReadStatus::ok);
  EXPECT_EQ(info.tid, 14);
}

TEST_F(Api, ReadsSlotsInPlace) {
  auto writer = make();
  auto reader = session.open_reader<Odometry>("odometry").value();
  {
    LoanedSample loan = writer.loan();
    ASSERT_TRUE(loan);
    Writer<Odometry>::view(loan) = sample(0);
    EXPECT_FALSE(writer.loan()) << "a second loan in the same thread would wait for ever";
    EXPECT_EQ(loan.publish(time_of(0)), 0);
    EXPECT_EQ(loan.publish(time_of(0)), kNoTid);
  }
  { LoanedSample dropped = writer.loan(); }
  EXPECT_EQ(writer.newest_tid(), 0);
  BorrowedSample borrowed;
  ASSERT_EQ(reader.borrow(0, borrowed), ReadStatus::ok);
  EXPECT_EQ(Reader<Odometry>::view(borrowed).theta, 0.5);
  EXPECT_TRUE(borrowed.still_valid());
  for (Tid tid = 1; tid <= 64; ++tid) write(writer, tid);
  EXPECT_FALSE(borrowed.still_valid());
}

TEST_F(Api, ASampleMayBeShorterThanItsStreams) {
  RawWriter writer = session.create_raw({"cloud", 0, ""}, {"", 12, 4, {}}, {8, 10ms}).value();
  auto reader = session.open_raw_reader({"cloud", 0, ""}).value();
  using Cloud = std::array<std::uint32_t, 3>;
  auto typed = session.open_reader<Cloud>("cloud").value();
  const Cloud full{1, 2, 3};
  const auto bytes = std::as_bytes(std::span(full));
  EXPECT_EQ(writer.write(bytes), 0);
  EXPECT_EQ(writer.write(bytes.first(4)), 1);
  {
    LoanedSample loan = writer.loan();
    std::copy_n(bytes.begin(), 8, loan.payload().begin());
    loan.shorten(8);
    loan.shorten(100);
    EXPECT_EQ(loan.publish(time_of(0)), 2);
  }
  {
    LoanedSample loan = writer.loan();
    loan.shorten(0);
    ASSERT_TRUE(loan);
    EXPECT_EQ(loan.publish(time_of(0)), 3);
  }
  const std::vector<std::byte> too_long(13);
  EXPECT_EQ(writer.write(too_long), kNoTid);
  for (const auto& [tid, expected, length] :
       {std::tuple{0, full, 12u}, std::tuple{1, Cloud{1}, 4u}, std::tuple{2, Cloud{1, 2}, 8u},
        std::tuple{3, Cloud{}, 0u}}) {
    SampleInfo info;
    std::array<std::byte, 12> raw;
    ASSERT_EQ(reader.read_tid(tid, raw, info), ReadStatus::ok);
    EXPECT_EQ(info.payload_bytes, length);
    Cloud out{7, 7, 7};
    ASSERT_EQ(typed.read_tid(tid, out, info), ReadStatus::ok);
    EXPECT_EQ(out, expected) << "what it does not have is 0";
    BorrowedSample borrowed;
    ASSERT_EQ(reader.borrow(tid, borrowed), ReadStatus::ok);
    EXPECT_EQ(borrowed.payload().size(), length);
  }
  Cloud out{7, 7, 7};
  std::array samples{typed.joint_sample(out)};
  ASSERT_EQ(read_joint_at(WallClock::now(), samples).status, ReadStatus::ok);
  EXPECT_EQ(out, Cloud{}) << "the newest one is empty";
}

TEST_F(Api, KeepsAnExistingRingWhenCreatedAgain) {
  auto first = make("odometry", {64, 10ms});
  write(first, 0);
  auto second = make("odometry", {10, 1s});
  EXPECT_EQ(second.depth(), 64u);
  EXPECT_EQ(second.incarnation(), first.incarnation());
  write(second, 1);
  write(first, 2);
  auto reader = session.open_reader<Odometry>("odometry").value();
  SampleInfo info;
  ASSERT_EQ(reader.read_info(0, info), ReadStatus::ok);
  EXPECT_EQ(info.time, time_of(0)) << "SSM zeroed all stamps here";
}

TEST_F(Api, NamesBothTypesWhenTheyDoNotMatch) {
  auto writer = make();
  for (const Error& error : {session.open_reader<Turned>("odometry").error(),
                             session.open_writer<Turned>("odometry").error(),
                             session.create<Turned>("odometry", History{64, 10ms}).error()}) {
    EXPECT_EQ(error.code, Errc::type_mismatch);
    EXPECT_NE(error.message.find("Odometry"), std::string::npos) << error.message;
    EXPECT_NE(error.message.find("Turned"), std::string::npos) << error.message;
  }
  const Error size = session.open_reader<double>("odometry").error();
  EXPECT_NE(size.message.find("24 bytes"), std::string::npos) << size.message;
  EXPECT_NE(size.message.find("8 bytes"), std::string::npos) << size.message;
  const Error bytes =
      session.create_raw({"odometry", 0, ""}, TypeInfo{"", 25, 1, {}}, {64, 10ms}).error();
  EXPECT_EQ(bytes.code, Errc::type_mismatch);
}

TEST_F(Api, AStreamWithoutADescriptionTakesThatOfTheNextWriter) {
  const auto fields = [&](std::string_view name) {
    return session.stream_info({std::string(name), 0, ""}).value().type.fields.size();
  };
  for (const std::string_view name : {"created", "opened"}) {
    // As a program of SSM does.
    auto plain = session.create_raw({std::string(name), 0, ""}, {"", 24, 1, {}}, {64, 10ms});
    const std::vector<std::byte> bytes(24);
    ASSERT_EQ(plain.value().write(bytes, time_of(0)), 0);
    ASSERT_TRUE(session.open_reader<Odometry>(name));
    EXPECT_EQ(fields(name), 0u) << "a reader may not describe it";
    auto writer = name == "opened" ? session.open_writer<Odometry>(name)
                                   : session.create<Odometry>(name, History{64, 10ms});
    ASSERT_TRUE(writer) << writer.error().message;
    EXPECT_EQ(fields(name), 3u);
    write(*writer, 1);
    EXPECT_EQ(session.open_writer<Turned>(name).error().code, Errc::type_mismatch);
  }
}

TEST_F(Api, AProgramThatAsksForMoreHistoryThanThereIsGetsItOrAnError) {
  const auto depth = [&](std::uint64_t asked, CreateOptions options = {}) {
    return session.create<Odometry>("odometry", History{asked, 10ms}, options).value().depth();
  };
  EXPECT_EQ(depth(64), 64u);
  EXPECT_EQ(depth(65), 65u) << "no program had the ring open";
  const auto writer = session.create<Odometry>("odometry", History{65, 10ms}).value();
  EXPECT_EQ(depth(10), 65u);
  EXPECT_EQ(depth(66, {.keep_existing = true}), 65u);
  const auto refused = session.create<Odometry>("odometry", History{66, 10ms});
  ASSERT_FALSE(refused);
  EXPECT_EQ(refused.error().code, Errc::conflict) << refused.error().message;
}

TEST_F(Api, ReportsWhatIsWrongWithARequest) {
  const auto expect = [](const auto& result, Errc code, const char* words) {
    ASSERT_FALSE(result) << "should have failed with: " << words;
    EXPECT_EQ(result.error().code, code) << result.error().message;
    EXPECT_NE(result.error().message.find(words), std::string::npos) << result.error().message;
  };
  expect(session.open_reader<Odometry>("nothing"), Errc::not_found, "'nothing");
  expect(session.create<Odometry>(std::string(32, 'x'), History{64, 1ms}), Errc::invalid_argument,
         "at most 31");
  expect(session.create<Odometry>("a", 1s, 0s), Errc::invalid_argument, "cycle of 0");
  expect(session.create<Odometry>("a", 0s, 1s), Errc::invalid_argument, "shorter than the cycle");
  expect(session.create<Odometry>("a", History{1, 1ms}), Errc::invalid_argument, "depth of 1");
  expect(session.create<Odometry>("a", History{64, -1ms}), Errc::invalid_argument, "cycle");
  expect(session.create_raw({"a", 0, ""}, TypeInfo{"", 0, 1, {}}, {64, 1ms}),
         Errc::invalid_argument, "0 bytes");
  expect(session.create_raw({"a", 0, ""}, TypeInfo{"", 64 << 20, 1, {}}, {1 << 20, 1ms}),
         Errc::limit_exceeded, "memory");
  expect(session.remove({"nothing", 0, ""}), Errc::not_found, "nothing");
  expect(session.stream_info({"nothing", 0, ""}), Errc::not_found, "nothing");
  expect(session.property({"nothing", 0, ""}), Errc::not_found, "nothing");
  make();
  expect(session.property({"odometry", 0, ""}), Errc::not_found, "property");
  expect(Session::connect({.socket_path = daemon.runtime_dir() + "/nobody.sock"}), Errc::no_daemon,
         "start dssmd");
  expect(Session::connect({.socket_path = std::string(200, 'x')}), Errc::invalid_argument,
         "107 bytes");
}

TEST(Connect, ReportsWhyItWasRefused) {
  DaemonProcess daemon({"--max-clients", "1"});
  auto first = Session::connect({.socket_path = daemon.socket_path()});
  ASSERT_TRUE(first) << first.error().message;
  auto second = Session::connect({.socket_path = daemon.socket_path()});
  ASSERT_FALSE(second);
  EXPECT_EQ(second.error().code, Errc::limit_exceeded) << second.error().message;
  EXPECT_NE(second.error().message.find("max_clients"), std::string::npos)
      << second.error().message;
}

TEST_F(Api, KeepsPropertiesOfAnySizeUpToTheirLimit) {
  auto writer = make();
  for (const std::size_t bytes : {1, 100, 9000, 100'000, 5, 1 << 20}) {
    std::vector<std::byte> property(bytes, static_cast<std::byte>(bytes % 251));
    ASSERT_TRUE(writer.set_property(property));
    EXPECT_EQ(session.property({"odometry", 0, ""}).value(), property);
    EXPECT_EQ(session.stream_info({"odometry", 0, ""}).value().property_bytes, bytes);
  }
  EXPECT_EQ(writer.set_property(std::vector<std::byte>((1 << 20) + 1)).error().code,
            Errc::limit_exceeded);
  ASSERT_TRUE(writer.set_property({}));
  EXPECT_EQ(session.property({"odometry", 0, ""}).error().code, Errc::not_found);
}

TEST_F(Api, WaitsForSamplesWithADeadline) {
  auto writer = make();
  auto other = make("other");
  auto reader = session.open_reader<Odometry>("odometry").value();
  auto other_reader = session.open_reader<Odometry>("other").value();
  EXPECT_EQ(reader.wait(MonoClock::now() - 1s), WaitStatus::timeout);
  EXPECT_EQ(reader.wait(deadline_in(5ms)), WaitStatus::timeout);
  RawReader* const both[] = {&reader, &other_reader};
  EXPECT_EQ(wait_any(both, deadline_in(5ms)), WaitStatus::timeout);
  std::thread later([&] { write(other, 0); });
  EXPECT_EQ(wait_any(both, kNever), WaitStatus::ready);
  later.join();
  EXPECT_EQ(reader.wait(MonoClock::now() - 1s), WaitStatus::timeout);
  EXPECT_EQ(other_reader.wait(MonoClock::now() - 1s), WaitStatus::ready) << "there already";
  std::thread more([&] {
    for (Tid tid = 0; tid < 5; ++tid) write(writer, tid);
  });
  EXPECT_EQ(reader.wait_for_tid(4, kNever), WaitStatus::ready);
  EXPECT_EQ(reader.newest_tid(), 4);
  more.join();
}

TEST_F(Api, ReportsASignalThatInterruptsAWait) {
  auto writer = make();
  auto reader = session.open_reader<Odometry>("odometry").value();
  const test::Signals signals;
  EXPECT_EQ(reader.wait(kNever), WaitStatus::interrupted);
}

TEST_F(Api, OffersADescriptorToEventLoops) {
  auto writer = make();
  auto reader = session.open_reader<Odometry>("odometry").value();
  const int fd = reader.ready_fd().value();
  pollfd poller{fd, POLLIN, 0};
  EXPECT_EQ(::poll(&poller, 1, 0), 0);
  Odometry out{};
  SampleInfo info;
  for (Tid tid = 0; tid < 100; ++tid) {
    write(writer, tid);
    ASSERT_EQ(::poll(&poller, 1, -1), 1);
    reader.clear_ready();
    ASSERT_EQ(reader.read_next(out, info), ReadStatus::ok);
    ASSERT_EQ(info.tid, tid);
  }
}

TEST_F(Api, WatchesOver127Descriptors) {
  std::vector<Writer<Odometry>> writers;
  std::vector<Reader<Odometry>> readers;
  std::vector<pollfd> fds;
  for (int i = 0; i < 200; ++i) {
    writers.push_back(make("s" + std::to_string(i), {4, 1ms}));
    readers.push_back(session.open_reader<Odometry>("s" + std::to_string(i)).value());
    fds.push_back({readers.back().ready_fd().value(), POLLIN, 0});
  }
  for (auto& writer : writers) write(writer, 0);
  for (auto& fd : fds) EXPECT_EQ(::poll(&fd, 1, -1), 1);
}

TEST_F(Api, ListsStreamsWithTheirFigures) {
  auto writer = make("odometry:2");
  auto reader = session.open_reader<Odometry>("odometry:2").value();
  for (Tid tid = 0; tid < 30; ++tid) write(writer, tid);
  make("second");
  const std::vector<StreamInfo> list = session.list_streams().value();
  ASSERT_EQ(list.size(), 2u);
  const StreamInfo& first = list[0];
  EXPECT_EQ(first.id, (StreamId{"odometry", 2, "pc1"}));
  EXPECT_EQ(first.type, type_of<Odometry>());
  EXPECT_EQ(first.depth, 64u);
  EXPECT_EQ(first.cycle, 10ms);
  EXPECT_EQ(first.newest, 29);
  EXPECT_EQ(first.oldest, 0);
  EXPECT_EQ(first.newest_time, time_of(29));
  EXPECT_NEAR(first.rate_hz, 10, 1e-6);
  EXPECT_EQ(first.writers, 1u);
  EXPECT_EQ(first.readers, 1u);
  EXPECT_EQ(first.creator_pid, ::getpid());
  EXPECT_EQ(list[1].id.name, "second");
  EXPECT_EQ(list[1].newest, kNoTid);
  EXPECT_EQ(list[1].writers, 0u) << "its writer is gone";
  const StreamInfo info = session.stream_info({"odometry", 2, ""}).value();
  ASSERT_EQ(info.users.size(), 2u);
  EXPECT_EQ(info.users[0].pid, ::getpid());
  EXPECT_EQ(session.stream_info({"odometry", 2, "pc1"}).value().id, first.id);
  EXPECT_EQ(session.stream_info({"odometry", 2, "pc9"}).error().code, Errc::not_found);
  EXPECT_EQ(session.daemon_info().value().host, "pc1");
  EXPECT_EQ(session.daemon_info().value().pid, daemon.pid());
  EXPECT_EQ(session.daemon_info().value().streams, 2u);
  ASSERT_EQ(session.list_clients().value().size(), 1u);
  EXPECT_EQ(session.list_clients().value()[0].pid, ::getpid());
  ASSERT_EQ(session.list_opens().value().size(), 2u);
}

TEST_F(Api, RemovesAStreamButNotFromThoseWhoHoldIt) {
  auto writer = make();
  auto reader = session.open_reader<Odometry>("odometry").value();
  write(writer, 0);
  ASSERT_TRUE(session.remove({"odometry", 0, ""}));
  EXPECT_EQ(session.open_reader<Odometry>("odometry").error().code, Errc::not_found);
  write(writer, 1);
  EXPECT_EQ(reader.newest_tid(), 1);
  auto recreated = make();
  EXPECT_NE(recreated.incarnation(), writer.incarnation());
  EXPECT_EQ(recreated.newest_tid(), kNoTid);
}

TEST_F(Api, NotifiesWatchersOfAddedAndRemovedStreams) {
  make("before");
  SeenEvents watched(session);
  make("later");
  ASSERT_TRUE(session.remove({"before", 0, ""}));
  std::vector<std::string> seen;
  for (const StreamEvent& event : watched.await(3)) {
    seen.push_back((event.kind == StreamEvent::Kind::added ? "+" : "-") + event.stream.id.name);
  }
  EXPECT_EQ(seen, (std::vector<std::string>{"+before", "+later", "-before"}));
}

TEST_F(Api, NotifiesWatchersOfPropertiesWithTheNewestSample) {
  auto writer = make("s");
  SeenEvents watched(session);
  const std::byte property[] = {std::byte{1}, std::byte{2}};
  ASSERT_TRUE(writer.set_property(property));
  for (int i = 0; i < 5; ++i) write(writer, i);
  ASSERT_TRUE(writer.set_property(property));  // the same bytes
  ASSERT_TRUE(writer.set_property({}));
  const std::vector<StreamEvent> seen = watched.await(4);
  EXPECT_FALSE(seen[0].property_set);
  const Tid newest[] = {kNoTid, kNoTid, 4, 4};
  const std::uint64_t bytes[] = {0, 2, 2, 0};
  for (std::size_t i = 0; i < 4; ++i) {
    EXPECT_EQ(seen[i].kind, StreamEvent::Kind::added);
    EXPECT_EQ(seen[i].property_set, i > 0);
    EXPECT_EQ(seen[i].stream.id, writer.id());
    EXPECT_EQ(seen[i].stream.incarnation, writer.incarnation());
    EXPECT_EQ(seen[i].stream.newest, newest[i]) << i;
    EXPECT_EQ(seen[i].stream.property_bytes, bytes[i]) << i;
  }
}

TEST_F(Api, NotifiesWatchersOfDescriptions) {
  const TypeInfo type = type_of<Odometry>();
  const TypeInfo bytes{"", type.payload_bytes, type.alignment_bytes, {}};
  const RawWriter writer = session.create_raw({"s", 0, ""}, bytes, History{4, 10ms}).value();
  SeenEvents watched(session);
  ASSERT_TRUE(session.describe(writer.id(), type));
  const std::vector<StreamEvent> seen = watched.await(2);
  EXPECT_FALSE(seen[0].described);
  EXPECT_TRUE(seen[1].described);
  EXPECT_FALSE(seen[1].property_set);
  EXPECT_EQ(seen[1].stream.type, type);
  EXPECT_EQ(seen[1].stream.incarnation, writer.incarnation());
}

TEST_F(Api, AwaitsAStreamThatComesLater) {
  EXPECT_EQ(session.await_reader<Odometry>("late", deadline_in(10ms)).error().code,
            Errc::not_found);
  std::thread creator([&] { make("late"); });
  EXPECT_TRUE(session.await_reader<Odometry>("late"));
  creator.join();
}

TEST_F(Api, SharesOnePlaybackClock) {
  Session other = test::connect(daemon);
  PlaybackClock clock = session.open_playback_clock().value(),
                seen = other.open_playback_clock().value();
  EXPECT_EQ(seen.setting().speed, 1);
  clock.set_paused(true);
  clock.set_time(500);
  EXPECT_EQ(seen.now_s(), 500);
  clock.set_speed(-2);
  EXPECT_EQ(seen.now_s(), 500);
  EXPECT_EQ(seen.setting().speed, -2);
  clock.reset();
  EXPECT_EQ(seen.setting().offset_s, 0);
  EXPECT_FALSE(seen.setting().paused);
}

std::size_t count_of(const std::string& folder) {
  std::size_t count = 0;
  for ([[maybe_unused]] const auto& entry : std::filesystem::directory_iterator(folder)) ++count;
  return count;
}

TEST_F(Api, LeaksNothingIn10000OpensAndCloses) {
  constexpr int kTimes = test::kIsSanitized ? 1000 : 10'000;
  auto writer = make();
  const auto files_of = [&](pid_t pid) { return "/proc/" + std::to_string(pid) + "/fd"; };
  const auto once = [&] {
    auto reader = session.open_reader<Odometry>("odometry").value();
    auto second = session.open_writer<Odometry>("odometry").value();
  };
  once();
  ASSERT_TRUE(session.list_streams());  // an answer after the closes: they are done
  const std::size_t ours = count_of(files_of(::getpid())), maps = count_of("/proc/self/map_files");
  const std::size_t theirs = count_of(files_of(daemon.pid()));
  for (int i = 0; i < kTimes; ++i) once();
  ASSERT_TRUE(session.list_streams());
  EXPECT_EQ(count_of(files_of(::getpid())), ours);
  EXPECT_LE(count_of("/proc/self/map_files"), maps + 4);  // malloc may map an arena
  EXPECT_EQ(count_of(files_of(daemon.pid())), theirs);
  EXPECT_EQ(session.stream_info({"odometry", 0, ""}).value().writers, 1u);
  EXPECT_EQ(session.list_opens().value().size(), 1u);
}

TEST_F(Api, Serves1000StreamsAnd1000Clients) {
  rlimit files{};
  ASSERT_EQ(::getrlimit(RLIMIT_NOFILE, &files), 0);
  files.rlim_cur = files.rlim_max;
  ASSERT_EQ(::setrlimit(RLIMIT_NOFILE, &files), 0);
  ASSERT_GE(files.rlim_max, 12'000u) << "this machine's `ulimit -Hn` is too small for the test";
  std::vector<Writer<double>> writers;
  for (int i = 0; i < 1000; ++i) {
    writers.push_back(session.create<double>("s" + std::to_string(i), History{4, 1ms}).value());
    ASSERT_EQ(writers.back().write(i), 0);
  }
  std::vector<Session> sessions;
  std::vector<Reader<double>> readers;
  for (int i = 0; i < 1000; ++i) {
    sessions.push_back(test::connect(daemon));
    readers.push_back(sessions.back().open_reader<double>("s" + std::to_string(i)).value());
  }
  for (int i = 0; i < 1000; ++i) {
    double out = 0;
    SampleInfo info;
    ASSERT_EQ(readers[static_cast<std::size_t>(i)].read_newest(out, info), ReadStatus::ok);
    ASSERT_EQ(out, i);
  }
  EXPECT_EQ(session.list_streams().value().size(), 1000u);
  EXPECT_EQ(session.list_clients().value().size(), 1001u);
}

}  // namespace
}  // namespace dssm
