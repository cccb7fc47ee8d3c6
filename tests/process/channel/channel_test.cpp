// SPDX-License-Identifier: Apache-2.0
//
// Channels of a running dssmd over real sockets: every sample once, large ones, lapped readers,
// publishing over connections that break.
#include <gtest/gtest.h>
#include <sys/socket.h>

#include <atomic>
#include <random>
#include <thread>

#include "core/ring/ring_reader.hpp"
#include "tests/process/channel/local_writer.hpp"
#include "tests/support/largest_payload.hpp"
#include "tests/support/network_peer.hpp"
#include "tests/support/sanitized.hpp"

namespace dssm::test {
namespace {

bool has_payload_of(Tid tid, const net::Frame& frame) {
  return is_payload_of(tid, std::as_bytes(std::span(frame.payload())));
}

SampleInfo info_of(Tid tid) { return {tid, time_from_ns(1'000'000 + tid * 1000), Duration(5)}; }

// Takes a subscription's frames: in order, whole, and every tid either there or in a gap.
struct Judge {
  Tid next = kNoTid;
  std::uint64_t samples = 0, lost = 0, torn = 0;
  bool caught_up = false;

  void take(const net::Frame& frame) {
    if (frame.has_caught_up()) caught_up = true;
    if (frame.has_subscribed()) next = frame.subscribed().first_tid();
    if (frame.has_gap()) {
      EXPECT_EQ(frame.gap().first_tid(), next);
      next += static_cast<Tid>(frame.gap().count());
      lost += frame.gap().count();
    }
    if (!frame.has_sample()) return;
    if (frame.torn()) {
      ++torn;
      return;
    }
    const Tid tid = frame.sample().tid();
    EXPECT_EQ(tid, next);
    EXPECT_EQ(frame.sample().time_ns(), 1'000'000 + tid * 1000);
    EXPECT_TRUE(has_payload_of(tid, frame)) << "sample " << tid;
    next = tid + 1;
    ++samples;
  }
  // Until sample `last` was there or is lost.
  void take_up_to(NetworkPeer& peer, Tid last) {
    while (next <= last) {
      const std::optional<net::Frame> frame = peer.try_receive();
      ASSERT_TRUE(frame);
      take(*frame);
    }
  }
};

class Channel : public testing::Test {
 protected:
  DaemonProcess daemon_{{"--log-level", "warning"}};
  RawClient local_{daemon_.socket_path()};
};

TEST_F(Channel, BringsEverySampleOnceWhileTheWriterWrites) {
  for (const std::size_t bytes : {64u, 20'000u}) {
    const int count = bytes == 64 ? 100'000 : 3000;
    LocalWriter writer(local_, "s" + std::to_string(bytes), bytes, bytes == 64 ? 131'072 : 4096);
    writer.write(count / 10);
    NetworkPeer peer = NetworkPeer::greeted(daemon_.address());
    peer.open("s" + std::to_string(bytes));
    peer.send(with_serial(1000, subscribe_from_oldest_frame()));
    std::thread writing([&] { writer.write(count - count / 10); });
    Judge judge;
    judge.take_up_to(peer, count - 1);
    writing.join();
    EXPECT_EQ(judge.samples, static_cast<std::uint64_t>(count));
    EXPECT_EQ(judge.lost, 0u);
    EXPECT_TRUE(judge.caught_up);
  }
}

// A writer that wraps around the ring all the time, and a reader that does not keep up.
TEST_F(Channel, SkipsALappedReaderForwardAndCountsExactly) {
  constexpr std::size_t kLarge = kLargestPayloadBytes / 20;
  for (const bool torn : {true, false}) {
    for (const std::size_t bytes : {std::size_t{100}, std::size_t{50'000}, kLarge}) {
      const std::string name = "lap" + std::to_string(bytes) + (torn ? "t" : "");
      LocalWriter writer(local_, name, bytes, 6);
      NetworkPeer peer = NetworkPeer::greeted(daemon_.address(), torn);
      peer.open(name);
      Judge judge;
      judge.take(peer.ask(subscribe_from_oldest_frame()));
      const int count = (bytes == kLarge ? 100 : 3000) / (kIsSanitized ? 5 : 1);
      std::thread writing([&] { writer.write(count); });
      judge.take_up_to(peer, count - 1);
      writing.join();
      EXPECT_EQ(judge.samples + judge.lost, static_cast<std::uint64_t>(count));
      EXPECT_GT(judge.samples, 0u);
      EXPECT_TRUE(torn || judge.torn == 0);
    }
  }
}

TEST_F(Channel, AnswersReadsWholeThoughTheWriterLapsThem) {
  for (const bool torn : {true, false}) {
    const std::string name = torn ? "readt" : "read";
    LocalWriter writer(local_, name, 1'000'000, 4);
    writer.write();
    NetworkPeer peer = NetworkPeer::greeted(daemon_.address(), torn);
    peer.open(name);
    std::atomic<bool> done = false;
    std::thread writing([&] {
      while (!done) writer.write();
    });
    Tid newest = kNoTid;
    for (int i = 0; i < 30 || newest <= 0; ++i) {
      const net::Frame answer = peer.ask(read_newest_frame());
      if (answer.has_no_sample()) {
        EXPECT_EQ(answer.no_sample().status(), 3u) << "lapped again and again, at worst";
        continue;
      }
      ASSERT_TRUE(answer.has_sample());
      EXPECT_GE(answer.sample().tid(), newest);
      newest = answer.sample().tid();
      EXPECT_TRUE(has_payload_of(newest, answer));
    }
    done = true;
    writing.join();
    EXPECT_GT(newest, 0);
  }
}

TEST_F(Channel, CarriesTheLargestAndTheSmallestSamples) {
  for (const std::size_t bytes : {std::size_t{1}, kLargestPayloadBytes}) {
    const std::string name = "size" + std::to_string(bytes);
    NetworkPeer publisher = NetworkPeer::greeted(daemon_.address());
    NetworkPeer reader = NetworkPeer::greeted(daemon_.address());
    EXPECT_TRUE(publisher.create(name, bytes, 3).created());
    reader.open(name);
    Judge judge;
    judge.take(reader.ask(subscribe_from_oldest_frame()));
    const net::Frame started = publisher.ask(start_publishing_frame(5));
    ASSERT_TRUE(started.has_publishing()) << started.failure().message();
    std::vector<std::byte> payload(bytes);
    for (Tid tid = 0; tid < 3; ++tid) {
      fill_payload(tid, payload);
      publisher.send_sample(info_of(tid), payload, static_cast<std::uint64_t>(tid) + 100);
      const net::Frame published = publisher.receive();
      EXPECT_EQ(published.published().last_tid(), tid) << published.failure().message();
      judge.take_up_to(reader, tid);
    }
    EXPECT_EQ(judge.samples, 3u);
    const net::Frame answer = reader.ask(read_frame(2));
    EXPECT_TRUE(has_payload_of(2, answer));
    EXPECT_EQ(answer.payload().size(), bytes);
  }
}

TEST_F(Channel, WritesEachPublishedSampleOnceThoughConnectionsBreakAnywhere) {
  const auto seed = std::random_device()();
  SCOPED_TRACE("seed " + std::to_string(seed));
  std::mt19937 random(seed);
  constexpr std::int64_t kSamples = 5000;
  NetworkPeer::greeted(daemon_.address()).create("once", 40, 8192);
  std::vector<std::byte> payload(40);
  int connections = 0;
  for (std::int64_t acknowledged = -1; acknowledged < kSamples - 1; ++connections) {
    NetworkPeer peer = NetworkPeer::greeted(daemon_.address());
    peer.open("once");
    const std::int64_t last = peer.ask(start_publishing_frame(77)).publishing().last();
    EXPECT_GE(last, acknowledged);
    acknowledged = last;
    // Some samples, the last of them cut off somewhere, and no waiting for what is acknowledged.
    const std::int64_t end = std::min<std::int64_t>(kSamples, last + 1 + random() % 400);
    for (std::int64_t number = last + 1; number < end; ++number) {
      fill_payload(number, payload);
      peer.send_sample(info_of(number), payload);
    }
    if (random() % 2) peer.send_bytes(std::string_view("\x49\x12\x1b\x09").substr(0, random() % 4));
    if (random() % 2) ::shutdown(peer.fd(), SHUT_WR);
  }
  EXPECT_GT(connections, 10);
  NetworkPeer reader = NetworkPeer::greeted(daemon_.address());
  reader.open("once");
  Judge judge;
  judge.take(reader.ask(subscribe_from_oldest_frame()));
  while (!judge.caught_up) judge.take(reader.receive());  // bytes and times are checked by tid
  EXPECT_EQ(judge.samples, static_cast<std::uint64_t>(kSamples));
}

// Whatever was acknowledged: the next dssmd gets the ring back, and knows it from there.
TEST_F(Channel, ReportsAfterARestartWhatWasWrittenBefore) {
  constexpr std::int64_t kSamples = 10'000;
  LocalWriter program(local_, "once", 40, 16);  // keeps the ring
  std::int64_t last = -1;
  for (int run = 0; run < 3; ++run) {
    RawClient local(daemon_.socket_path());
    if (run > 0) program.offer(local);
    NetworkPeer peer = NetworkPeer::greeted(daemon_.address());
    peer.open("once");
    const net::Publishing publishing = peer.ask(start_publishing_frame(77)).publishing();
    EXPECT_EQ(publishing.last(), last);
    EXPECT_EQ(publishing.last_tid(), last);
    const std::int64_t end = last + 1 + kSamples;
    for (std::int64_t number = last + 1; number < end; ++number) {
      peer.send_sample(info_of(number), Bytes(40));
    }
    last = end - 1;
    ASSERT_TRUE(eventually([&] { return program.newest() == last; }));
    daemon_.kill_hard();
    daemon_.start();
  }
}

TEST_F(Channel, WakesLocalReadersOfWhatIsPublished) {
  NetworkPeer publisher = NetworkPeer::greeted(daemon_.address());
  publisher.create("wake", 16, 8);
  publisher.ask(start_publishing_frame(1));
  const Answer opened = local_.ask(open_request("wake"));
  const auto mapping =
      ring::RingMapping::open_untrusted(opened.descriptors.at(0).get(), ring::Access::read_only)
          .value();
  const auto bell = ring::Bell::open_untrusted(opened.descriptors.at(1).get()).value();
  const ring::RingReader reader(*mapping);
  const std::uint32_t announced = bell->announce();
  ASSERT_EQ(reader.newest(), kNoTid);
  publisher.send_sample(info_of(0), Bytes(16));
  while (reader.newest() == kNoTid) {
    ASSERT_NE(bell->sleep(announced, deadline_in(std::chrono::seconds(kTimeoutSeconds))),
              WaitStatus::timeout);
  }
}

// After a kill and after a proper stop.
TEST(ChannelAfterARestart, WaitsForTheRingThatAWriterKept) {
  DaemonProcess daemon(kPatientRecovery);
  RawClient before(daemon.socket_path());
  LocalWriter writer(before, "kept", 64, 1024);
  for (const bool is_killed : {true, false}) {
    if (is_killed) {
      daemon.kill_hard();
    } else {
      EXPECT_EQ(daemon.stop(), 0);
    }
    writer.write(5);
    daemon.start();
    NetworkPeer peer = NetworkPeer::greeted(daemon.address());
    peer.send(with_serial(1, open_frame("kept")));
    NetworkPeer other = NetworkPeer::greeted(daemon.address());  // so dssmd has the request
    EXPECT_TRUE(other.ask(ping_frame()).has_pong()) << "nothing else waits";
    RawClient again(daemon.socket_path());
    writer.offer(again);
    EXPECT_EQ(peer.receive().opened().stream().newest(), is_killed ? 4 : 9);
  }
}

// --- many kinds of peers

TEST_F(Channel, DescribesTheStreamsOfItsHost) {
  LocalWriter writer(local_, "a", 16, 32);
  writer.write(3);
  NetworkPeer control = NetworkPeer::greeted(daemon_.address());
  NetworkPeer channel = NetworkPeer::greeted(daemon_.address());
  EXPECT_EQ(control.server().host(), "pc1");
  EXPECT_EQ(control.server().program(), "dssmd");
  EXPECT_EQ(control.server().host_id().size(), 16u);
  EXPECT_NE(control.server().instance_id(), 0u);
  channel.open("a");
  net::Frame info;
  info.mutable_info()->mutable_id()->set_name("a");
  const net::Frame answer = control.ask(info);
  ASSERT_EQ(answer.stream_list().streams_size(), 1);
  const proto::Stream& stream = answer.stream_list().streams(0);
  EXPECT_EQ(stream.newest(), 2);
  EXPECT_EQ(stream.writers(), 1u);
  EXPECT_EQ(stream.channels(), 1u);
  EXPECT_EQ(stream.remote_readers(), 1u);
  ASSERT_EQ(stream.users_size(), 2);
  EXPECT_EQ(stream.users(0).pid(), ::getpid());
  EXPECT_EQ(stream.users(1).via(), proto::CONNECTION);
  control.send(with_serial(500, watch_frame()));
  EXPECT_EQ(control.receive().stream_event().stream().id().name(), "a");
  EXPECT_TRUE(control.receive().has_done());
  local_.ask(create_request("b"));
  EXPECT_EQ(control.receive().stream_event().stream().id().name(), "b");
  EXPECT_TRUE(control.ask(remove_frame("a")).has_done());
  EXPECT_TRUE(channel.receive().ended().removed());
}

TEST(ChannelAddresses, MayBeIPv6AndSeveral) {
  if (::access("/proc/net/if_inet6", F_OK)) GTEST_SKIP() << "this kernel has no IPv6";
  const DaemonProcess daemon({"--listen", "127.0.0.1:0", "--listen", "[::1]:0"});
  ASSERT_EQ(daemon.addresses().size(), 2u);
  EXPECT_TRUE(daemon.addresses()[1].starts_with("[::1]:")) << daemon.addresses()[1];
  for (const std::string& address : daemon.addresses()) {
    NetworkPeer peer = NetworkPeer::greeted(address);
    EXPECT_TRUE(peer.ask(list_frame()).has_stream_list());
  }
}

TEST(ChannelAddresses, ThatAreConfiguredMustBeFree) {
  const DaemonProcess first;
  const std::string dir = make_temp_dir();
  const Finished second = run(
      {built("daemon/dssmd"), "--runtime-dir", dir, "--name", "pc2", "--listen", first.address()});
  EXPECT_EQ(second.exit_status, 1);
  EXPECT_NE(second.err.find("'" + first.address() + "'"), std::string::npos) << second.err;
  remove_tree(dir);
}

TEST(ChannelAddresses, BeyondThisPcTakeInsecure) {
  const Finished refused = run({built("daemon/dssmd"), "--check-config", "--listen", "0.0.0.0:0"});
  EXPECT_EQ(refused.exit_status, 2);
  EXPECT_NE(refused.err.find("insecure = true"), std::string::npos) << refused.err;
  const DaemonProcess open({"--listen", "0.0.0.0:0", "--insecure"});
  EXPECT_TRUE(open.address().starts_with("0.0.0.0:")) << open.address();
}

}  // namespace
}  // namespace dssm::test
