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
#include "tests/support/service_manager.hpp"
#include "tests/support/session.hpp"

namespace dssm::test {
namespace {

using namespace std::chrono_literals;

constexpr int kStreams = 3;

struct Numbered {
  std::int64_t number;
  std::int64_t again[15];  // the same number, to detect tearing
};
DSSM_DESCRIBE(Numbered, number, again)

Numbered numbered(std::int64_t number) {
  Numbered sample{number, {}};
  for (auto& word : sample.again) word = number;
  return sample;
}

std::string stream_name(int number) { return "load" + std::to_string(number); }

// Writes one stream at 1 kHz, with its own session, like a sensor handler.
class Handler {
 public:
  Handler(const std::string& socket_path, int number)
      : session_(connect_to(socket_path)),
        writer_(session_.create<Numbered>(stream_name(number), History{1 << 16, 1ms}).value()),
        thread_([this] {
          while (!done_) {
            EXPECT_EQ(writer_.write(numbered(written_.load())), written_.load());
            ++written_;
            std::this_thread::sleep_for(1ms);  // the load's rate, not a wait for anything
          }
        }) {}
  Handler(const Handler&) = delete;
  Handler& operator=(const Handler&) = delete;
  ~Handler() { stop(); }

  std::int64_t written() const { return written_.load(); }
  std::int64_t stop() {
    done_ = true;
    if (thread_.joinable()) thread_.join();
    return written();
  }

 private:
  Session session_;
  Writer<Numbered> writer_;
  std::atomic<bool> done_ = false;
  std::atomic<std::int64_t> written_ = 0;
  std::thread thread_;
};

// Reads every sample of a stream, from the first one on, and checks it.
class Taker {
 public:
  Taker(const std::string& socket_path, const std::string& name)
      : session_(connect_to(socket_path)),
        reader_(session_.await_reader<Numbered>(name, deadline_in(60s)).value()),
        thread_([this] { take(); }) {}
  Taker(const Taker&) = delete;
  Taker& operator=(const Taker&) = delete;
  ~Taker() {
    done_ = true;
    if (thread_.joinable()) thread_.join();
  }

  std::int64_t taken() const { return taken_.load(); }
  void await_taken(std::int64_t count) const {
    while (taken() < count && !testing::Test::HasFailure()) std::this_thread::sleep_for(1ms);
  }
  std::uint64_t lost() const { return reader_.lost_samples(); }

 private:
  void take() {
    reader_.seek(kNoTid);
    Numbered sample{};
    SampleInfo info;
    while (!done_) {
      if (reader_.wait(deadline_in(50ms)) != WaitStatus::ready) continue;
      const ReadStatus status = reader_.read_next(sample, info);
      if (status == ReadStatus::not_yet) continue;
      ASSERT_EQ(status, ReadStatus::ok);  // nothing else happens to a reader
      ASSERT_EQ(info.tid, taken_.load());
      ASSERT_EQ(sample.number, taken_.load());
      for (const std::int64_t word : sample.again) ASSERT_EQ(word, taken_.load());
      ++taken_;
    }
  }

  Session session_;
  Reader<Numbered> reader_;
  std::atomic<bool> done_ = false;
  std::atomic<std::int64_t> taken_ = 0;
  std::thread thread_;
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
        remote[s]->await_taken(handlers[s]->written() + 50);
        local[s]->await_taken(handlers[s]->written());
      }
      ASSERT_FALSE(HasFailure());
    }
    for (int i = 0; i < kStreams; ++i) {
      const auto s = static_cast<std::size_t>(i);
      const std::int64_t written = handlers[s]->stop();
      local[s]->await_taken(written);
      remote[s]->await_taken(written);
      EXPECT_EQ(local[s]->taken(), written);
      EXPECT_EQ(remote[s]->taken(), written);
      EXPECT_EQ(local[s]->lost(), 0u);
      EXPECT_EQ(remote[s]->lost(), 0u);
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
