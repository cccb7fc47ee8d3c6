// SPDX-License-Identifier: Apache-2.0
//
// Peers on the network that break the rules, or just never read: each costs its own connection,
// and nobody else notices.
#include <fcntl.h>
#include <gtest/gtest.h>
#include <signal.h>
#include <sys/socket.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <atomic>
#include <cstdio>
#include <cstdlib>
#include <filesystem>
#include <random>
#include <thread>

#include "core/wire/local_protocol.hpp"
#include "tests/process/channel/local_writer.hpp"
#include "tests/support/network_peer.hpp"
#include "tests/support/sanitized.hpp"

namespace dssm::test {
namespace {

constexpr std::uint64_t kMiB = 1U << 20;

class BadPeer : public testing::Test {
 protected:
  // Every test ends with good peers that are still served, and a dssmd without leftovers.
  void TearDown() override {
    EXPECT_TRUE(good_.ask(list_frame()).has_stream_list());
    EXPECT_TRUE(local_.ask(list_request()).response.has_stream_list());
    EXPECT_TRUE(eventually([&] { return open_descriptors(daemon_.pid()) == descriptors_; }))
        << "dssmd keeps descriptors of a peer that is gone";
  }

  DaemonProcess daemon_{{"--log-level", "error"}};
  RawClient local_{daemon_.socket_path()};
  NetworkPeer good_ = NetworkPeer::greeted(daemon_.address());
  int descriptors_ = idle_descriptors(daemon_.pid());
};

TEST_F(BadPeer, ThatSendsGarbageGetsAnError) {
  NetworkPeer http(daemon_.address());
  http.send_bytes(
      "GET / HTTP/1.1\r\nHost: pc1\r\nUser-Agent: a browser that lost its way home\r\n\r\n");
  EXPECT_NE(http.final_failure(), "");
  NetworkPeer endless(daemon_.address());
  endless.send_bytes(std::string(64, '\xff'));
  EXPECT_NE(endless.final_failure(), "");
  NetworkPeer long_frame = NetworkPeer::greeted(daemon_.address());
  long_frame.send_bytes(std::string("\xff\xff\xff\xff\x0f", 5));  // 2^32 - 1 bytes
  EXPECT_NE(long_frame.final_failure().find("4294967295 bytes"), std::string::npos);
}

TEST_F(BadPeer, ThatSendsRandomBytesCostsOnlyItself) {
  const auto seed = std::random_device()();
  SCOPED_TRACE("seed " + std::to_string(seed));
  std::mt19937 random(seed);
  for (int round = 0; round < 300; ++round) {
    NetworkPeer peer(daemon_.address());
    if (round % 2 == 0) {
      ASSERT_FALSE(peer.greet());
    }
    std::string bytes(1 + random() % 5000, '\0');
    for (char& c : bytes) c = static_cast<char>(random());
    peer.send_bytes(bytes);
    ::shutdown(peer.fd(), SHUT_WR);
    peer.await_end();
    // Often: dssmd closes what is silent for 10 s.
    EXPECT_TRUE(good_.ask(list_frame()).has_stream_list());
  }
}

// One of each frame of the protocol; all are about the stream "lidar".
std::vector<std::string> all_frames() {
  std::vector<std::string> frames;
  for (const auto& entry : std::filesystem::directory_iterator(source("tests/golden/network"))) {
    if (entry.path().extension() == ".hex") frames.push_back(golden_bytes(entry.path()));
  }
  std::ranges::sort(frames);  // so that a seed means the same on each machine
  return frames;
}

// Some of the frames, in any order, with some other bytes in them.
std::string changed(const std::vector<std::string>& frames, std::mt19937& random) {
  std::string bytes;
  for (std::size_t left = 1 + random() % 12; left > 0; --left) {
    std::string frame = frames[random() % frames.size()];
    // Rarely in the length in front, after which nothing is understood any more.
    for (std::size_t changes = random() % 3; changes > 0; --changes) {
      frame[std::max<std::size_t>(random() % frame.size(), random() % 8 ? 1 : 0)] =
          static_cast<char>(random());
    }
    bytes += frame;
  }
  if (random() % 4 == 0) bytes.resize(random() % bytes.size());
  return bytes;
}

// $DSSM_FUZZ_SECONDS: for so long; $DSSM_TEST_SEED: as in an earlier run.
TEST_F(BadPeer, ThatSendsAnyFramesInAnyOrderCostsOnlyItself) {
  const char* const seconds = std::getenv("DSSM_FUZZ_SECONDS");
  const char* const earlier = std::getenv("DSSM_TEST_SEED");
  const auto seed = earlier ? static_cast<unsigned>(std::stoul(earlier)) : std::random_device()();
  std::printf("DSSM_TEST_SEED=%u\n", seed);
  std::mt19937 random(seed);
  const std::vector<std::string> frames = all_frames();
  ASSERT_GT(frames.size(), 40);
  const MonoTime until = MonoClock::now() + std::chrono::seconds(seconds ? std::stoi(seconds) : 0);
  int rounds = 0;
  for (; rounds < 200 || MonoClock::now() < until; ++rounds) {
    NetworkPeer writer = NetworkPeer::greeted(daemon_.address());
    writer.create("lidar", 24, 16);
    ASSERT_TRUE(writer.ask(start_publishing_frame(1)).has_publishing());
    NetworkPeer peer(daemon_.address());
    ASSERT_TRUE(peer.is_open());
    if (random() % 8) {
      ASSERT_FALSE(peer.greet());
    }
    if (random() % 2) peer.send(with_serial(1, open_frame("lidar")));
    peer.send_bytes(changed(frames, random));
    for (Tid tid = 0; tid < 20; ++tid) writer.send_sample({.tid = tid}, Bytes(24));
    if (random() % 4 == 0) {  // a reset instead of an end
      const linger at_once{1, 0};
      ::setsockopt(peer.fd(), SOL_SOCKET, SO_LINGER, &at_once, sizeof at_once);
    } else {
      ::shutdown(peer.fd(), SHUT_WR);
      std::array<char, 4096> answers{};
      while (::recv(peer.fd(), answers.data(), answers.size(), 0) > 0) {
      }
    }
    peer.close();
    // What it created has other names each time, and would take descriptors.
    const net::Frame list = good_.ask(list_frame());
    ASSERT_TRUE(list.has_stream_list());
    for (const proto::Stream& stream : list.stream_list().streams()) {
      net::Frame remove;
      *remove.mutable_remove()->mutable_id() = stream.id();
      good_.ask(remove);
    }
  }
  std::printf("%d peers\n", rounds);
}

TEST_F(BadPeer, OfALaterVersionIsRefusedNamingBothVersionsAndHosts) {
  NetworkPeer peer(daemon_.address());
  peer.send(client_hello_frame(1000));
  const std::string words = peer.final_failure();
  EXPECT_NE(words.find("version 1000"), std::string::npos) << words;
  EXPECT_NE(words.find("version 1;"), std::string::npos) << words;
  EXPECT_NE(words.find("'pc1'"), std::string::npos) << words;
}

// What a peer is told that is closed before its Hello. With credentials nothing: only after its
// first bytes it is known whether it speaks TLS.
testing::AssertionResult is_told(const std::string& failure, const std::string& words) {
  const bool is_right = tests_tls() ? failure.empty() : failure.find(words) != failure.npos;
  return (is_right ? testing::AssertionSuccess() : testing::AssertionFailure()) << failure;
}

TEST_F(BadPeer, ThatNeverFinishesItsHelloIsClosed) {
  NetworkPeer silent(daemon_.address()), slow(daemon_.address());
  slow.send_bytes("\x20");
  EXPECT_TRUE(is_told(silent.final_failure(), "no Hello"));
  EXPECT_NE(slow.final_failure().find("no Hello"), std::string::npos);
}

TEST_F(BadPeer, ThatStopsInTheMiddleOfAFrameIsNotMissed) {
  const std::string frame = wire::encode_frame(with_serial(1, create_frame("half", 16, 8)));
  for (std::size_t part = 1; part < frame.size(); ++part) {
    NetworkPeer peer = NetworkPeer::greeted(daemon_.address());
    peer.send_bytes(std::string_view(frame).substr(0, part));
  }
  EXPECT_EQ(good_.ask(list_frame()).stream_list().streams_size(), 0);
}

TEST_F(BadPeer, ThatPublishesWithoutSayingSoOrInAnotherSizeIsRefused) {
  {
    NetworkPeer peer = NetworkPeer::greeted(daemon_.address());
    peer.create("p", 16, 8);
    peer.send_sample({.tid = 0}, Bytes(16));
    EXPECT_NE(peer.final_failure().find("StartPublishing"), std::string::npos);
    NetworkPeer other = NetworkPeer::greeted(daemon_.address());
    other.open("p");
    other.ask(start_publishing_frame(1));
    other.send_sample({.tid = 0}, Bytes(17));
    EXPECT_NE(other.final_failure().find("17 bytes"), std::string::npos);
  }
  EXPECT_TRUE(good_.ask(remove_frame("p")).has_done());
}

// Never reads: neither its subscription, nor what it asks for.
TEST_F(BadPeer, ThatNeverReadsStaysWithinItsHostsMemoryAndDelaysNoOther) {
#ifdef __SANITIZE_THREAD__
  GTEST_SKIP() << "a peer that is as slow as this test counts as silent";
#endif
  RawClient writing(daemon_.socket_path());
  {
    LocalWriter camera(writing, "camera", kMiB, 4), fast(writing, "fast", 64, 65536);
    local::Request set;
    set.mutable_set_property()->mutable_id()->set_name("camera");
    set.mutable_set_property()->set_property(std::string(wire::kMaxPropertyBytes, 'p'));
    EXPECT_TRUE(local_.ask(set).response.has_done());

    std::vector<NetworkPeer> bad;
    for (int i = 0; i < 30; ++i) {
      bad.push_back(NetworkPeer::greeted(daemon_.address()));
      bad.back().open("camera");
      net::Frame frame = i % 3 == 0 ? net::Frame() : subscribe_from_oldest_frame();
      if (i % 3 == 0) frame.mutable_get_property();
      for (std::uint64_t serial = 100; serial < 105; ++serial) {
        bad.back().send(with_serial(serial, frame));
      }
    }
    NetworkPeer reader = NetworkPeer::greeted(daemon_.address());
    reader.open("fast");
    ASSERT_TRUE(reader.ask(subscribe_from_oldest_frame()).has_subscribed());
    for (Tid tid = 0; tid < 2000; ++tid) {
      if (tid % 20 == 0) {
        camera.write();
        ASSERT_TRUE(good_.ask(list_frame()).has_stream_list());
      }
      fast.write();
      std::optional<net::Frame> frame = reader.try_receive();
      while (frame && !frame->has_sample()) frame = reader.try_receive();
      ASSERT_TRUE(frame);
      ASSERT_EQ(frame->sample().tid(), tid);
    }
    // 96 MiB is what one address may take; the rest is dssmd itself.
    if (kMemoryIsMeasurable) {
      EXPECT_LT(private_memory(daemon_.pid()), 130 * kMiB);
    }
  }
  for (const char* name : {"camera", "fast"}) {
    EXPECT_TRUE(good_.ask(remove_frame(name)).has_done());
  }
}

TEST_F(BadPeer, ThatRequestsWithoutPauseDoesNotDelayOthers) {
  NetworkPeer busy = NetworkPeer::greeted(daemon_.address());
  std::string many;
  for (int i = 0; i < 500; ++i) many += wire::encode_frame(with_serial(100, list_frame()));
  std::atomic<bool> served{false};
  std::thread sending([&] {
    while (::send(busy.fd(), many.data(), many.size(), MSG_NOSIGNAL) > 0) {
    }
    EXPECT_TRUE(served) << "the connection ended early";
  });
  std::thread receiving([&] {
    std::array<char, 1U << 16> answers{};
    while (::recv(busy.fd(), answers.data(), answers.size(), 0) > 0) {
    }
  });
  for (int i = 0; i < 20; ++i) EXPECT_TRUE(good_.ask(list_frame()).has_stream_list());
  served = true;
  ::shutdown(busy.fd(), SHUT_RDWR);
  sending.join();
  receiving.join();
}

TEST_F(BadPeer, WhoseRequestFindsNoMemoryEndsItsConnectionOnly) {
  if (!kMemoryIsMeasurable) GTEST_SKIP() << "a sanitizer needs memory itself";
  ASSERT_TRUE(local_.ask(create_request("odometry")).response.has_opened());
  net::Frame request;
  request.mutable_set_property()->mutable_id()->set_name("odometry");
  request.mutable_set_property()->set_property(std::string(wire::kMaxPropertyBytes, 'p'));
  {
    const MemoryLimit limit(daemon_.pid(), kMiB / 2);
    NetworkPeer peer = NetworkPeer::greeted(daemon_.address());
    EXPECT_FALSE(peer.ask(request).has_done());
    EXPECT_TRUE(good_.ask(list_frame()).has_stream_list());
  }
  EXPECT_TRUE(good_.ask(request).has_done());
  local::Request remove;
  remove.mutable_remove()->mutable_id()->set_name("odometry");
  EXPECT_TRUE(local_.ask(remove).response.has_done());
  descriptors_ = idle_descriptors(daemon_.pid());
}

// A connection over `fd` that says nothing, half of a Hello, garbage, or a Hello and then garbage.
void misuse(int fd, std::mt19937_64& random, const std::string& hello) {
  std::string garbage(random() % 300, '\0');
  for (char& byte : garbage) byte = static_cast<char>(random());
  std::string bytes;
  switch (random() % 4) {
    case 0:
      break;
    case 1:
      bytes = hello.substr(0, random() % hello.size());
      break;
    case 2:
      bytes = garbage;
      break;
    default:
      bytes = hello + garbage;
  }
  if (!bytes.empty()) static_cast<void>(::send(fd, bytes.data(), bytes.size(), MSG_NOSIGNAL));
  if (random() % 2 == 0) {  // a reset instead of an end
    const linger at_once{1, 0};
    ::setsockopt(fd, SOL_SOCKET, SO_LINGER, &at_once, sizeof at_once);
  }
}

TEST_F(BadPeer, ManyOfAllKindsLeaveNothingBehind) {
  const std::uint64_t seed = std::random_device{}();
  SCOPED_TRACE("seed " + std::to_string(seed));
  std::mt19937_64 random(seed);
  const std::string hello = wire::encode_frame(client_hello_frame());
  local::Request greeting;
  greeting.set_serial(1);
  greeting.mutable_hello()->set_protocol_version(wire::kLocalProtocolVersion);
  const std::string local_hello = wire::encode_frame(greeting);
  const auto all_have_ended = [&] { return open_descriptors(daemon_.pid()) == descriptors_; };
  constexpr int kTimes = kIsSanitized ? 2'000 : 10'000;
  std::uint64_t after_half = 0;
  for (int i = 0; i < kTimes; ++i) {
    // The heap keeps the size that the most connections at one time needed: never many, so that
    // a busy machine does not make it grow.
    if (i % 5 == 0) {
      ASSERT_TRUE(eventually(all_have_ended));
    }
    if (i == kTimes / 2) {
      after_half = private_memory(daemon_.pid());
    }
    const NetworkPeer peer(daemon_.address());
    ASSERT_TRUE(peer.is_open());
    misuse(peer.fd(), random, hello);
    const Result<UniqueFd> program = wire::connect_unix(daemon_.socket_path());
    ASSERT_TRUE(program) << program.error().message;
    misuse(program->get(), random, local_hello);
    if (i % 50 == 0) {
      EXPECT_TRUE(good_.ask(list_frame()).has_stream_list());
    }
  }
  EXPECT_TRUE(eventually(all_have_ended));
  if (kMemoryIsMeasurable) {
    EXPECT_LT(private_memory(daemon_.pid()), after_half + 4 * kMiB);
  }
}

TEST(BadPeers, AreCounted) {
  const DaemonProcess daemon({"--max-connections", "3", "--max-connections-per-host", "2"});
  NetworkPeer one = NetworkPeer::greeted(daemon.address());
  NetworkPeer two = NetworkPeer::greeted(daemon.address());
  NetworkPeer three(daemon.address());
  const std::string words = three.final_failure();
  EXPECT_TRUE(is_told(words, "max_connections_per_host = 2"));
  EXPECT_TRUE(is_told(words, "'pc1'"));
  one.close();
  EXPECT_TRUE(eventually([&] {
    NetworkPeer again(daemon.address());
    return !again.greet() && again.is_open();
  }));
  EXPECT_TRUE(two.ask(list_frame()).has_stream_list());
}

TEST(BadPeers, ThatTakeAllPlacesKeepOutNoConfiguredPeer) {
  const DaemonProcess daemon({"--max-connections", "2", "--peer", "127.0.0.1:1"});
  const wire::SocketAddress at =
      wire::resolve_number(wire::Address::parse(daemon.address()).value()).at(0);
  const wire::SocketAddress from =
      wire::resolve_number(wire::Address::parse("127.0.0.2:0", 0, true).value()).at(0);
  const auto connect = [&] {
    UniqueFd socket(::socket(AF_INET, SOCK_STREAM | SOCK_CLOEXEC, 0));
    EXPECT_EQ(::bind(socket.get(), from.get(), from.length), 0);
    EXPECT_EQ(::connect(socket.get(), at.get(), at.length), 0);
    return NetworkPeer(std::move(socket));
  };
  NetworkPeer silent[] = {connect(), connect()};
  NetworkPeer others[] = {connect(), connect()};
  EXPECT_TRUE(is_told(silent[0].final_failure(), "it has sent no Hello"));
  for (NetworkPeer& other : others) EXPECT_FALSE(other.greet());
  EXPECT_TRUE(is_told(connect().final_failure(), "max_connections = 2"));
  NetworkPeer configured = NetworkPeer::greeted(daemon.address());
  EXPECT_TRUE(configured.ask(list_frame()).has_stream_list());
  for (NetworkPeer& other : others) EXPECT_TRUE(other.ask(list_frame()).has_stream_list());
}

TEST(BadPeers, ThatComeAndGoDoNotFillTheLog) {
  const std::string dir = make_temp_dir();
  int ends[2];
  ASSERT_EQ(::pipe2(ends, O_CLOEXEC), 0);
  std::string log;
  std::thread reading([&] {
    char buffer[4096];
    for (ssize_t got; (got = ::read(ends[0], buffer, sizeof buffer)) > 0;) {
      log.append(buffer, static_cast<std::size_t>(got));
    }
  });
  const pid_t pid = ::fork();
  if (pid == 0) {
    ::dup2(ends[1], 2);
    const std::string program = built("daemon/dssmd");
    ::execl(program.c_str(), "dssmd", "--runtime-dir", dir.c_str(), "--name", "pc1", "--listen",
            "127.0.0.1:0", nullptr);
    ::_exit(127);
  }
  ::close(ends[1]);
  const std::string path = dir + "/dssmd.sock";
  ASSERT_TRUE(eventually([&] { return wire::connect_unix(path).has_value(); }));
  RawClient local(path);
  local::Request hosts;
  hosts.mutable_list_hosts();
  const std::string address = local.ask(hosts).response.host_list().hosts(0).addresses(0);
  for (int i = 0; i < 2000; ++i) {
    NetworkPeer peer(address);
    peer.send_bytes(std::string(16, '\xff'));
    peer.final_failure();
  }
  ::kill(pid, SIGTERM);
  EXPECT_EQ(wait_for(pid), 0);
  reading.join();
  ::close(ends[0]);
  EXPECT_LT(std::count(log.begin(), log.end(), '\n'), 500) << log.substr(0, 2000);
  remove_tree(dir);
}

}  // namespace
}  // namespace dssm::test
