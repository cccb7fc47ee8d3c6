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
#include <random>
#include <thread>

#include "core/wire/fd_socket.hpp"
#include "core/wire/frame.hpp"
#include "tests/process/channel/raw_peer.hpp"

namespace dssm::test {
namespace {

constexpr std::uint64_t kMiB = 1U << 20;

// Sanitizers keep for a while what was freed.
#if defined(__SANITIZE_ADDRESS__) || defined(__SANITIZE_THREAD__)
constexpr bool kMemoryTells = false;
#else
constexpr bool kMemoryTells = true;
#endif

class BadPeer : public testing::Test {
 protected:
  // Every test ends with good peers that are still served, and a dssmd without leftovers.
  void TearDown() override {
    EXPECT_TRUE(good_.ask(network_list()).frame.has_stream_list());
    EXPECT_TRUE(local_.ask(list_request()).response.has_stream_list());
    EXPECT_TRUE(eventually([&] { return open_descriptors(daemon_.pid()) == descriptors_; }))
        << "dssmd keeps descriptors of a peer that is gone";
  }

  DaemonProcess daemon_{{"--log-level", "error"}};
  RawClient local_{daemon_.socket_path()};
  RawPeer good_{daemon_.address()};
  int descriptors_ = open_descriptors(daemon_.pid());
};

TEST_F(BadPeer, ThatSendsGarbageIsToldSo) {
  RawPeer http(daemon_.address(), false);
  http.send_bytes(
      "GET / HTTP/1.1\r\nHost: pc1\r\nUser-Agent: a browser that lost its way home\r\n\r\n");
  EXPECT_NE(http.final_failure(), "");
  RawPeer endless(daemon_.address(), false);
  endless.send_bytes(std::string(64, '\xff'));
  EXPECT_NE(endless.final_failure(), "");
  RawPeer long_frame(daemon_.address());
  long_frame.send_bytes(std::string("\xff\xff\xff\xff\x0f", 5));  // 2^32 - 1 bytes
  EXPECT_NE(long_frame.final_failure().find("4294967295 bytes"), std::string::npos);
}

TEST_F(BadPeer, ThatSendsRandomBytesCostsOnlyItself) {
  const auto seed = std::random_device()();
  SCOPED_TRACE("seed " + std::to_string(seed));
  std::mt19937 random(seed);
  for (int round = 0; round < 300; ++round) {
    RawPeer peer(daemon_.address(), round % 2 == 0);
    std::string bytes(1 + random() % 5000, '\0');
    for (char& c : bytes) c = static_cast<char>(random());
    peer.send_bytes(bytes);
    ::shutdown(peer.fd(), SHUT_WR);
    while (!peer.receive().ended) {
    }
  }
}

TEST_F(BadPeer, ThatChangesBytesOfGoodFramesCostsOnlyItself) {
  const auto seed = std::random_device()();
  SCOPED_TRACE("seed " + std::to_string(seed));
  std::mt19937 random(seed);
  net::Frame create, subscribe = subscribe_from_oldest(), read, start, property;
  create.mutable_create()->mutable_id()->set_name("x");
  create.mutable_create()->mutable_type()->set_payload_bytes(16);
  create.mutable_create()->mutable_type()->set_alignment_bytes(8);
  create.mutable_create()->set_depth(8);
  create.mutable_create()->set_cycle_ns(1000);
  read.mutable_read()->set_newest(true);
  start.mutable_start_publishing()->set_publisher(4);
  property.mutable_set_property()->set_property("p");
  std::string good;
  std::uint64_t serial = 0;
  for (net::Frame* frame : {&create, &subscribe, &read, &start, &property, &read}) {
    frame->set_serial(++serial);
    good += wire::encode_frame(*frame);
  }
  for (int round = 0; round < 300; ++round) {
    RawPeer peer(daemon_.address());
    std::string bytes = good;
    for (int change = 0; change < 3; ++change) {
      bytes[random() % bytes.size()] = static_cast<char>(random());
    }
    peer.send_bytes(bytes);
    ::shutdown(peer.fd(), SHUT_WR);
    while (::recv(peer.fd(), bytes.data(), bytes.size(), 0) > 0) {
    }
    peer.close();
    // What it created has other names each time, and would take descriptors.
    const Received list = good_.ask(network_list());
    for (const proto::Stream& stream : list.frame.stream_list().streams()) {
      net::Frame remove;
      *remove.mutable_remove()->mutable_id() = stream.id();
      good_.ask(remove);
    }
  }
}

TEST_F(BadPeer, ThatComesFromTheFutureIsToldBothVersionsAndHosts) {
  RawPeer peer(daemon_.address(), false);
  peer.send(network_hello(1000));
  const std::string words = peer.final_failure();
  EXPECT_NE(words.find("version 1000"), std::string::npos) << words;
  EXPECT_NE(words.find("version 1;"), std::string::npos) << words;
  EXPECT_NE(words.find("'pc1'"), std::string::npos) << words;
}

TEST_F(BadPeer, ThatNeverFinishesItsHelloIsClosed) {
  RawPeer silent(daemon_.address(), false), slow(daemon_.address(), false);
  slow.send_bytes("\x20");
  EXPECT_NE(silent.final_failure().find("no Hello"), std::string::npos);
  EXPECT_NE(slow.final_failure().find("no Hello"), std::string::npos);
}

TEST_F(BadPeer, ThatStopsInTheMiddleOfAFrameIsNotMissed) {
  net::Frame create;
  create.set_serial(1);
  create.mutable_create()->mutable_id()->set_name("half");
  create.mutable_create()->mutable_type()->set_payload_bytes(16);
  create.mutable_create()->mutable_type()->set_alignment_bytes(8);
  create.mutable_create()->set_depth(8);
  create.mutable_create()->set_cycle_ns(1000);
  const std::string frame = wire::encode_frame(create);
  for (std::size_t part = 1; part < frame.size(); ++part) {
    RawPeer peer(daemon_.address());
    peer.send_bytes(std::string_view(frame).substr(0, part));
  }
  EXPECT_EQ(good_.ask(network_list()).frame.stream_list().streams_size(), 0);
}

TEST_F(BadPeer, ThatPublishesWithoutSayingSoOrInAnotherSizeIsRefused) {
  {
    RawPeer peer(daemon_.address());
    peer.create("p", 16, 8);
    peer.send_sample(0, std::vector<std::byte>(16), {});
    EXPECT_NE(peer.final_failure().find("StartPublishing"), std::string::npos);
    RawPeer other(daemon_.address());
    other.open("p");
    net::Frame start;
    start.mutable_start_publishing()->set_publisher(1);
    other.ask(start);
    other.send_sample(0, std::vector<std::byte>(17), {});
    EXPECT_NE(other.final_failure().find("17 bytes"), std::string::npos);
  }
  net::Frame remove;
  remove.mutable_remove()->mutable_id()->set_name("p");
  EXPECT_TRUE(good_.ask(remove).frame.has_done());
}

// Never reads: neither its subscription, nor what it asks for.
TEST_F(BadPeer, ThatNeverReadsTakesNoMoreThanItsHostMayAndDelaysNobody) {
  RawClient writing(daemon_.socket_path());
  {
    LocalWriter camera(writing, "camera", kMiB, 4), fast(writing, "fast", 64, 65536);
    local::Request set;
    set.mutable_set_property()->mutable_id()->set_name("camera");
    set.mutable_set_property()->set_property(std::string(16 * kMiB, 'p'));
    EXPECT_TRUE(local_.ask(set).response.has_done());

    std::vector<std::unique_ptr<RawPeer>> bad;
    for (int i = 0; i < 30; ++i) {
      bad.push_back(std::make_unique<RawPeer>(daemon_.address()));
      bad.back()->open("camera");
      net::Frame frame = i % 3 == 0 ? net::Frame() : subscribe_from_oldest();
      if (i % 3 == 0) frame.mutable_get_property();
      for (std::uint64_t serial = 100; serial < 105; ++serial) {
        frame.set_serial(serial);
        bad.back()->send(frame);
      }
    }
    RawPeer reader(daemon_.address());
    reader.open("fast");
    ASSERT_TRUE(reader.ask(subscribe_from_oldest()).frame.has_subscribed());
    for (Tid tid = 0; tid < 2000; ++tid) {
      if (tid % 20 == 0) camera.write();
      fast.write();
      Received received = reader.receive();
      while (!received.ended && !received.frame.has_sample()) received = reader.receive();
      ASSERT_EQ(received.frame.sample().tid(), tid);
    }
    // 96 MiB is what one address may take; the rest is dssmd itself.
    if (kMemoryTells) {
      EXPECT_LT(private_memory(daemon_.pid()), 130 * kMiB);
    }
  }
  for (const char* name : {"camera", "fast"}) {
    net::Frame remove;
    remove.mutable_remove()->mutable_id()->set_name(name);
    EXPECT_TRUE(good_.ask(remove).frame.has_done());
  }
}

TEST_F(BadPeer, ThatAsksWithoutPauseDoesNotKeepOthersWaiting) {
  RawPeer busy(daemon_.address());
  std::string many;
  net::Frame list = network_list();
  for (std::uint64_t serial = 100; serial < 50'100; ++serial) {
    list.set_serial(serial);
    many += wire::encode_frame(list);
  }
  std::thread sending([&] { busy.send_bytes(many); });
  for (int i = 0; i < 20; ++i) EXPECT_TRUE(good_.ask(network_list()).frame.has_stream_list());
  for (int i = 0; i < 50'000; ++i) ASSERT_FALSE(busy.receive().ended);
  sending.join();
}

TEST(BadPeers, AreCounted) {
  const DaemonProcess daemon({"--max-connections", "3", "--max-connections-per-host", "2"});
  RawPeer one(daemon.address()), two(daemon.address());
  RawPeer three(daemon.address(), false);
  const std::string words = three.final_failure();
  EXPECT_NE(words.find("max_connections_per_host = 2"), std::string::npos) << words;
  EXPECT_NE(words.find("'pc1'"), std::string::npos) << words;
  one.close();
  EXPECT_TRUE(eventually([&] {
    RawPeer again(daemon.address(), false);
    again.send(network_hello());
    return again.receive().frame.has_hello();
  }));
  EXPECT_TRUE(two.ask(network_list()).frame.has_stream_list());
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
    RawPeer peer(address, false);
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
