// SPDX-License-Identifier: Apache-2.0
//
// Programs and peers that misbehave, on another PC and on the owner's, while other programs write
// and read a stream: its readers lose nothing, dssmd's memory stays within its limit, and a bad
// peer's connection ends. The tests compare counts, never times.
#include <fcntl.h>
#include <unistd.h>

#include <csignal>
#include <fstream>
#include <random>
#include <sstream>
#include <thread>

#include "tests/process/network/fleet.hpp"
#include "tests/process/network/follower.hpp"
#include "tests/process/network/load.hpp"
#include "tests/support/network_peer.hpp"

namespace dssm::test {
namespace {

using namespace std::chrono_literals;

// What dssmd's tables and malloc may add; its rings are not anonymous memory.
constexpr std::uint64_t kOtherMemoryBytes = 8 << 20;

// pc1 owns steady_stream(), which is written continuously and read on pc1 and on pc2. The
// misbehaving peers are on pc3, or further programs.
class Misbehaviour : public NetworkTest {
 protected:
  // In a test: `if (!begin(8)) return;`
  bool begin(std::uint64_t max_peer_memory_mib) {
    max_peer_memory = max_peer_memory_mib << 20;
    if (!make_fleet(3, {"--max-peer-memory", std::to_string(max_peer_memory)})) return false;
    stop = false;
    writing = std::thread(
        [this] { LoadWriter(fleet->session(1), {steady_stream()}, 1).write_until(stop); });
    for (int host = 1; host <= 2; ++host) {
      Session session = fleet->session(host);
      Session owner = fleet->session(1);
      bystanders.push_back(std::make_unique<Bystander>(
          Follower(steady_stream(), session.await_raw_reader(steady_stream().id, kNever).value(),
                   owner.await_raw_reader(steady_stream().id, kNever).value())));
    }
    for (auto& bystander : bystanders) {
      reading.emplace_back([this, &bystander = *bystander] {
        do {
          (void)bystander.follower.reader().wait(deadline_in(50ms));
          bystander.follower.take(1000);
          bystander.taken = bystander.follower.taken();
        } while (!stop || !bystander.follower.has_all());
      });
    }
    await_progress();
    memory_before = anonymous_memory();
    return true;
  }

  void TearDown() override {
    if (!fleet) return;
    stop = true;
    writing.join();
    for (std::thread& each : reading) each.join();
    for (auto& bystander : bystanders) {
      EXPECT_EQ(bystander->follower.faults(), "");
      EXPECT_EQ(bystander->follower.lost(), 0u);
      EXPECT_EQ(bystander->follower.restarts(), 0u);
    }
  }

  // Waits until all bystanders have taken this many more samples.
  void await_progress(std::uint64_t samples = 1000) {
    for (auto& bystander : bystanders) {
      const std::uint64_t enough = bystander->taken + samples;
      while (bystander->taken < enough) std::this_thread::sleep_for(1ms);
    }
  }

  // Anonymous memory of pc1's dssmd.
  std::uint64_t anonymous_memory() {
    std::ifstream status("/proc/" + std::to_string(fleet->dssmd(1).pid()) + "/status");
    for (std::string word; status >> word;) {
      std::uint64_t kib = 0;
      if (word == "RssAnon:" && status >> kib) return kib << 10;
    }
    ADD_FAILURE() << "no RssAnon in /proc/PID/status";
    return 0;
  }

  void expect_bounded_memory() {
#ifdef __SANITIZE_ADDRESS__
    return;  // includes the sanitizer's own memory
#endif
    EXPECT_LT(anonymous_memory(), memory_before + max_peer_memory + kOtherMemoryBytes);
  }

  NetworkPeer connect_from(int host) {
    const Inside inside = fleet->network().inside(host);
    return NetworkPeer(Network::address(1));
  }

  // A stream whose ring takes 64 MiB, much more than max_peer_memory.
  RawWriter make_large() {
    return fleet->session(1).create_raw({"large", 0, ""}, {"", 1 << 20, 1, {}}, {64, 10ms}).value();
  }

  struct Bystander {
    explicit Bystander(Follower made) : follower(std::move(made)) {}
    Follower follower;
    std::atomic<std::uint64_t> taken = 0;
  };
  std::atomic<bool> stop = false;
  std::thread writing;
  std::vector<std::unique_ptr<Bystander>> bystanders;
  std::vector<std::thread> reading;
  std::uint64_t max_peer_memory = 0, memory_before = 0;
};

TEST_F(Misbehaviour, PeersThatSendNothingOrOneByteAreClosed) {
  if (!begin(8)) return;
  std::vector<NetworkPeer> silent;
  for (int i = 0; i < 20; ++i) {
    silent.push_back(connect_from(3));
    ASSERT_TRUE(silent.back().is_open());
    // The first byte of a Hello's length; the next one never follows.
    if (i % 2 == 0) silent.back().send_bytes("\x20");
  }
  await_progress();
  for (NetworkPeer& peer : silent) peer.await_end();
  await_progress();
  expect_bounded_memory();
}

TEST_F(Misbehaviour, PeersThatSendGarbageAreClosed) {
  if (!begin(8)) return;
  const std::uint64_t seed = number_from_environment("DSSM_TEST_SEED", std::random_device{}());
  SCOPED_TRACE(testing::Message() << "DSSM_TEST_SEED=" << seed);
  std::mt19937_64 random(seed);
  for (int i = 0; i < 100; ++i) {
    NetworkPeer peer = connect_from(3);
    ASSERT_TRUE(peer.is_open());
    // At the start; after a valid Hello; instead of a request on an open channel.
    if (i % 3 > 0) {
      ASSERT_FALSE(peer.greet());
    }
    if (i % 3 > 1) {
      ASSERT_TRUE(peer.ask(open_frame("steady")).has_opened());
    }
    std::string garbage(1 + random() % 100'000, '\0');
    for (char& byte : garbage) byte = static_cast<char>(random());
    peer.send_bytes(garbage);
    // Random bytes may begin with the length of an incomplete frame of up to 17 MiB; more zeros are
    // invalid in any case.
    peer.send_bytes(std::string(32U << 20, '\0'));
    peer.await_end();
  }
  await_progress();
  expect_bounded_memory();
}

TEST_F(Misbehaviour, PeersThatSubscribeAndNeverReadCostBoundedMemory) {
  if (!begin(8)) return;
  RawWriter large = make_large();
  std::vector<std::byte> payload(large.payload_bytes());
  std::vector<NetworkPeer> lazy;
  const MonoTime begun = MonoClock::now();
  for (int i = 0; i < 20; ++i) {
    lazy.push_back(connect_from(3));
    ASSERT_FALSE(lazy.back().greet());
    lazy.back().send(with_serial(1, open_frame(i % 2 == 0 ? "large" : "steady")));
    lazy.back().send(with_serial(2, subscribe_from_oldest_frame()));
  }
  // This takes much less than the 30 s after which the kernel ends connections that receive
  // nothing, unless this machine is stalled.
  for (int round = 0; round < (kSlowness > 1 ? 1 : 10); ++round) {
    for (int i = 0; i < 32; ++i) ASSERT_NE(large.write(payload), kNoTid);
    await_progress(200);
    expect_bounded_memory();
  }
  // A peer that reads at last gets every sample, or a gap that counts it.
  std::size_t served = 0;
  for (std::size_t i = 0; i < lazy.size(); ++i) {
    Tid next = 0;
    std::uint64_t samples = 0;
    const Tid enough = i % 2 == 0 ? large.newest_tid() : 2000;
    while (next <= enough) {
      const std::optional<net::Frame> frame = lazy[i].try_receive();
      if (!frame && MonoClock::now() - begun > 29s) break;
      ASSERT_TRUE(frame) << "the connection ended at tid " << next;
      if (frame->has_gap()) {
        ASSERT_EQ(frame->gap().first_tid(), next);
        next += static_cast<Tid>(frame->gap().count());
      } else if (frame->has_sample() && !frame->torn()) {
        ASSERT_EQ(frame->sample().tid(), next);
        ++next, ++samples;
      }
    }
    if (next <= enough) continue;
    EXPECT_GT(samples, 0u);
    ++served;
  }
  if (served == 0) GTEST_SKIP() << "this machine took 30 s before it read";
}

// dssmd stops reading from them; after a minute in which they receive nothing, the kernel ends
// their connections.
TEST_F(Misbehaviour, PeersThatRequestAndNeverReadAreStoppedAndThenClosed) {
  if (!begin(8)) return;
  RawWriter large = make_large();
  ASSERT_NE(large.write(std::vector<std::byte>(large.payload_bytes())), kNoTid);
  std::atomic<int> closed = 0;
  std::vector<std::thread> greedy;
  for (const bool whole_samples : {false, true}) {
    greedy.emplace_back([this, whole_samples, &closed] {
      NetworkPeer peer = connect_from(3);
      EXPECT_FALSE(peer.greet());
      if (whole_samples) peer.send(with_serial(1, open_frame("large")));
      net::Frame request = whole_samples ? read_newest_frame() : list_frame();
      for (std::uint64_t serial = 2; peer.is_open() && serial < 10'000'000; ++serial) {
        request.set_serial(serial);
        peer.send(request);
      }
      EXPECT_FALSE(peer.is_open()) << "ten million requests without a limit";
      ++closed;
    });
  }
  while (closed < 2) {
    await_progress();
    expect_bounded_memory();
  }
  for (std::thread& each : greedy) each.join();
}

TEST_F(Misbehaviour, ConnectionsBeyondTheLimitAreRefusedWithAnError) {
  if (!begin(96)) return;
  std::vector<NetworkPeer> many;
  int refused = 0, accepted = 0;
  for (int i = 0; i < 1000; ++i) {
    NetworkPeer& peer = many.emplace_back(connect_from(3));
    const std::optional<net::Frame> instead = peer.greet();
    if (!instead && peer.is_open()) {
      ++accepted;
      continue;
    }
    ++refused;
    if (!instead) continue;  // its error was lost with the connection
    EXPECT_NE(instead->failure().message().find("max_connections"), std::string::npos)
        << instead->failure().message();
  }
  EXPECT_GT(accepted, 100);
  EXPECT_GT(refused, 800);
  await_progress();
  expect_bounded_memory();
  // Other hosts are served meanwhile, and this one again after it closed its connections.
  EXPECT_FALSE(connect_from(2).greet());
  many.clear();
  while (connect_from(3).greet()) std::this_thread::sleep_for(1ms);
}

// A program that is stopped while it reads, and continued later.
class Stopped {
 public:
  Stopped(const std::vector<std::string>& words, const std::string& environment) {
    int in[2], out[2];
    EXPECT_EQ(::pipe2(in, O_CLOEXEC), 0);
    EXPECT_EQ(::pipe2(out, O_CLOEXEC), 0);
    std::vector<std::string> argv = {built("tests/process/network/steady-reader")};
    argv.insert(argv.end(), words.begin(), words.end());
    // start() has no parameter for stdin, so the program inherits ours.
    const UniqueFd own_stdin(::fcntl(STDIN_FILENO, F_DUPFD_CLOEXEC, 3));
    ::dup2(in[0], STDIN_FILENO);
    pid_ = start(argv, {environment}, out[1]);
    ::dup2(own_stdin.get(), STDIN_FILENO);
    ::close(in[0]), ::close(out[1]);
    stdin_.reset(in[1]);
    stdout_.reset(out[0]);
    char byte = 0;
    EXPECT_EQ(::read(stdout_.get(), &byte, 1), 1) << "it ended early";
    ::kill(pid_, SIGSTOP);
  }

  // Continues it until its end; returns its output.
  void finish(std::uint64_t& taken, std::uint64_t& lost) {
    ::kill(pid_, SIGCONT);
    stdin_.reset();
    std::string text;
    char buffer[4096];
    for (ssize_t n; (n = ::read(stdout_.get(), buffer, sizeof buffer)) > 0;) {
      text.append(buffer, static_cast<std::size_t>(n));
    }
    EXPECT_EQ(wait_for(pid_), 0) << text;
    std::istringstream(text) >> taken >> lost;
  }

 private:
  pid_t pid_ = -1;
  UniqueFd stdin_, stdout_;
};

TEST_F(Misbehaviour, StoppedReadersDisturbNoOthersAndContinueWhereTheyStopped) {
  if (!begin(8)) return;
  std::vector<std::unique_ptr<Stopped>> stopped;
  for (int host = 1; host <= 3; ++host) {
    stopped.push_back(
        std::make_unique<Stopped>(std::vector<std::string>{}, fleet->dssmd(host).environment()));
  }
  {
    const Inside inside = fleet->network().inside(3);
    stopped.push_back(std::make_unique<Stopped>(std::vector<std::string>{Network::address(1)},
                                                "DSSM_SOCKET=/nowhere"));
  }
  for (int round = 0; round < 5; ++round) {
    await_progress();
    expect_bounded_memory();
  }
  for (auto& each : stopped) {
    std::uint64_t taken = 0, lost = 0;
    each->finish(taken, lost);
    EXPECT_GT(taken, 5000u);
    EXPECT_EQ(lost, 0u) << "the ring holds a minute";
  }
}

}  // namespace
}  // namespace dssm::test
