// SPDX-License-Identifier: Apache-2.0
//
// dssmd as a service, killed, restarted, and stopped and started under load: three writers at 1
// kHz, a reader of each on this PC and one on another. No sample is lost, torn or delivered
// twice, and readers on this PC get no event.
#include <gtest/gtest.h>

#include <atomic>
#include <csignal>
#include <dssm/dssm.hpp>
#include <thread>

#include "tests/support/daemon_process.hpp"
#include "tests/support/samples.hpp"
#include "tests/support/service_manager.hpp"
#include "tests/support/session.hpp"

namespace dssm::test {
namespace {

using namespace std::chrono_literals;

constexpr int kStreams = 3;

std::string stream_name(int number) { return "load" + std::to_string(number); }

// Writes one stream at 1 kHz, with its own session, like a sensor handler.
struct Handler {
  Handler(const std::string& socket_path, int number)
      : session(connect_to(socket_path)),
        writer(session.create<Numbered>(stream_name(number), kLong).value()) {}
  Session session;
  Writer<Numbered> writer;
  WriterThread thread{writer, 1ms};
};

// Reads every sample of a stream, from the first one on, with its own session.
struct Taker {
  Taker(const std::string& socket_path, const std::string& name)
      : session(connect_to(socket_path)),
        reader(session.await_reader<Numbered>(name, deadline_in(60s)).value()) {}
  Session session;
  Reader<Numbered> reader;
  ReaderThread thread{reader};
};

class ServiceUnderLoad : public testing::Test {
 protected:
  // Calls `end_and_start` five times under load.
  void run(const std::function<void()>& end_and_start) {
    std::vector<std::unique_ptr<Handler>> handlers;
    std::vector<std::unique_ptr<Taker>> local, remote;
    for (int i = 0; i < kStreams; ++i) {
      handlers.push_back(std::make_unique<Handler>(pc1.socket_path(), i));
      local.push_back(std::make_unique<Taker>(pc1.socket_path(), stream_name(i)));
      remote.push_back(std::make_unique<Taker>(pc2.socket_path(), stream_name(i) + "@pc1"));
    }
    Session watching = connect_to(pc1.socket_path());
    std::atomic<int> events = 0;
    const auto watch = watching.watch([&](const StreamEvent&) { ++events; });
    ASSERT_TRUE(watch);
    ASSERT_EQ(events.load(), kStreams);
    for (int round = 0; round < 5; ++round) {
      end_and_start();
      // All are connected again, and samples cross the network.
      for (int i = 0; i < kStreams; ++i) {
        const auto s = static_cast<std::size_t>(i);
        remote[s]->thread.await_taken(handlers[s]->thread.written() + 50);
        local[s]->thread.await_taken(handlers[s]->thread.written());
      }
      ASSERT_FALSE(HasFailure());
    }
    for (int i = 0; i < kStreams; ++i) {
      const auto s = static_cast<std::size_t>(i);
      const std::int64_t written = handlers[s]->thread.stop();
      local[s]->thread.await_taken(written);
      remote[s]->thread.await_taken(written);
      EXPECT_EQ(local[s]->thread.taken(), written);
      EXPECT_EQ(remote[s]->thread.taken(), written);
      EXPECT_EQ(local[s]->reader.lost_samples(), 0u);
      EXPECT_EQ(remote[s]->reader.lost_samples(), 0u);
    }
    ASSERT_TRUE(watching.list_streams());  // it has reconnected and received all events
    EXPECT_EQ(events.load(), kStreams) << "a watching program on this PC noticed the restart";
  }

  ServiceManager pc1{{.arguments = kPatientRecovery}};
  DaemonProcess pc2{{"--peer", pc1.address()}, "pc2"};
};

TEST_F(ServiceUnderLoad, LosesNothingWhenItIsKilled) {
  run([this] {
    pc1.kill_hard();
    pc1.start();
  });
}

TEST_F(ServiceUnderLoad, LosesNothingWhenItIsRestarted) {
  run([this] { pc1.restart(); });
  EXPECT_EQ(pc1.doubled(), 0) << "dssmd sent again what is in the store";
}

// systemd 252 then empties the store: the programs give all streams back.
TEST_F(ServiceUnderLoad, LosesNothingWhenItIsStoppedAndStarted) {
  run([this] {
    EXPECT_EQ(pc1.stop(), 0);
    pc1.start();
  });
}

TEST(Service, KeepsStreamsWhoseProgramsHaveAllEnded) {
  ServiceManager manager({.arguments = {"--listen", ""}});
  std::uint64_t incarnation = 0;
  {
    Session session = connect_to(manager.socket_path());
    auto writer = session.create<Numbered>("kept", History{16, 1ms}).value();
    incarnation = writer.incarnation();
    for (int i = 0; i < 5; ++i) writer.write(numbered(i));
    ASSERT_TRUE(writer.set_property(std::vector<std::byte>(1000, std::byte{7})));
    PlaybackClock clock = session.open_playback_clock().value();
    clock.set_paused(true);
    clock.set_time(1234);
  }
  for (const bool hard : {true, false, true}) {
    hard ? manager.kill_hard() : manager.restart();
    if (hard) manager.start();
    Session session = connect_to(manager.socket_path());
    const StreamInfo info = session.stream_info({"kept", 0, ""}).value();
    EXPECT_EQ(info.incarnation, incarnation);
    EXPECT_EQ(info.type, type_of<Numbered>());
    EXPECT_EQ(session.property({"kept", 0, ""}).value(),
              std::vector<std::byte>(1000, std::byte{7}));
    EXPECT_EQ(session.open_playback_clock().value().now_s(), 1234);
    auto reader = session.open_reader<Numbered>("kept").value();
    Numbered sample{};
    SampleInfo sample_info;
    EXPECT_EQ(reader.read_newest(sample, sample_info), ReadStatus::ok);
    EXPECT_EQ(sample_info.tid, 4);
    EXPECT_EQ(sample.number, 4);
  }
}

// A property that is set again is in the same memory file, which the store has already.
TEST(Service, KeepsThePropertyThatWasSetAfterARestart) {
  ServiceManager manager({.arguments = {"--listen", ""}});
  connect_to(manager.socket_path()).create<Numbered>("s", History{16, 1ms}).value();
  manager.restart();
  {
    Session session = connect_to(manager.socket_path());
    ASSERT_TRUE(session.set_property({"s", 0, ""}, std::vector<std::byte>(3, std::byte{9})));
  }
  manager.restart();
  EXPECT_EQ(connect_to(manager.socket_path()).property({"s", 0, ""}).value(),
            std::vector<std::byte>(3, std::byte{9}));
}

// With a complete store there is no wait for recovery_grace: an unknown name is free.
TEST(Service, DoesNotWaitForOffersWithACompleteStore) {
  ServiceManager manager({.arguments = {"--recovery-grace", "60 s"}});
  manager.restart();
  Session session =
      Session::connect({.socket_path = manager.socket_path(), .request_timeout = 30s}).value();
  auto writer = session.create<Numbered>("new", History{16, 1ms});
  ASSERT_TRUE(writer) << writer.error().message;
  manager.restart();
  auto another = session.create<Numbered>("another", History{16, 1ms});
  ASSERT_TRUE(another) << another.error().message;
}

}  // namespace
}  // namespace dssm::test
