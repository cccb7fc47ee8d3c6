// SPDX-License-Identifier: Apache-2.0
//
// A dssmd's server end without sockets: streams, a ChannelServer, and peers of the test's own.
#pragma once

#include <netinet/in.h>

#include <algorithm>
#include <string>
#include <vector>

#include "core/ring/ring_writer.hpp"
#include "daemon/serve/channel_server.hpp"
#include "tests/support/log_recorder.hpp"
#include "tests/unit/daemon/daemon_fixtures.hpp"
#include "tests/unit/daemon/link/fake_transport.hpp"

namespace dssm::daemon {

inline wire::Greeting greeting_of(const std::string& program, const std::string& host) {
  wire::Greeting greeting;
  greeting.host = host;
  greeting.host_id.fill(7);
  greeting.instance_id = 1;
  greeting.program = program;
  greeting.version = "0.1.0";
  return greeting;
}

inline wire::SocketAddress address_of(std::uint32_t last_number) {
  wire::SocketAddress address;
  sockaddr_in number{};
  number.sin_family = AF_INET;
  number.sin_port = htons(40000);
  number.sin_addr.s_addr = htonl(0x0a000000 + last_number);  // 10.0.0.x
  std::memcpy(&address.storage, &number, sizeof number);
  address.length = sizeof number;
  return address;
}

inline net::Frame hello_frame(const wire::Greeting& greeting) {
  net::Frame frame;
  wire::to_message(greeting, *frame.mutable_hello());
  return frame;
}

inline net::Frame sample_read(std::uint64_t serial, Tid tid) {
  net::Frame frame;
  frame.set_serial(serial);
  frame.mutable_read()->set_tid(tid);
  return frame;
}

class ServerRig {
 public:
  explicit ServerRig(const PeerTable::Limits& limits = {16, 8, 32U << 20},
                     ClockAssessor* clock = nullptr, Authorizer authorizer = authorize)
      : server({loop, registry, opens, logger, clock, {}, std::move(authorizer)},
               greeting_of("dssmd", "pc1"), limits) {}

  // Connects; without `greet` it says nothing. The peer outlives the rig's use of it.
  void connect(FakePeer& peer, bool greet = true, bool torn = true, std::uint32_t host = 2) {
    const Result<void> adopted =
        server.adopt(std::make_unique<FakeTransport>(peer), address_of(host));
    ASSERT_TRUE(adopted) << adopted.error().message;
    if (!greet) return;
    wire::Greeting greeting = greeting_of("test", "pc" + std::to_string(host));
    if (torn) greeting.features.emplace_back(wire::kFeatureTorn);
    peer.put(hello_frame(greeting));
    turns();
    const std::vector<SentItem> items = take(peer);
    ASSERT_EQ(items.size(), 1u);
    EXPECT_EQ(items[0].frame.hello().host(), "pc1");
  }
  void open(FakePeer& peer, const std::string& name) {
    net::Frame frame;
    frame.set_serial(1000);
    frame.mutable_open()->mutable_id()->set_name(name);
    peer.put(frame);
    turns();
    const std::vector<SentItem> items = take(peer);
    ASSERT_EQ(items.size(), 1u);
    ASSERT_TRUE(items[0].frame.has_opened()) << items[0].frame.failure().message();
  }

  std::shared_ptr<Stream> create(const std::string& name, std::uint64_t payload_bytes = 24,
                                 std::uint64_t depth = 16) {
    TypeInfo type{"", payload_bytes, 8, {}};
    const Result<Registry::Created> created =
        registry.create({name, 0, ""}, type, {depth, std::chrono::milliseconds(10)}, 42);
    EXPECT_TRUE(created) << created.error().message;
    return created ? created->stream : nullptr;
  }
  // As a program of this PC writes.
  void write(Stream& stream, int count = 1) {
    const OfferedFiles files = as_offer(stream.descriptors_for(Role::writer).value());
    const auto mapping =
        ring::RingMapping::open_untrusted(files.ring.get(), ring::Access::read_write).value();
    const auto bell = ring::Bell::open_untrusted(files.bell.get()).value();
    ring::RingWriter writer(*mapping, *bell, files.doorbell.get());
    for (int i = 0; i < count; ++i) {
      const Tid tid = writer.newest() + 1;
      writer.write(payload_for(tid, stream.type().payload_bytes), time_from_ns(1000 + tid * 10),
                   Duration(3));
    }
  }
  static std::vector<std::byte> payload_for(Tid tid, std::uint64_t bytes) {
    return std::vector<std::byte>(bytes, static_cast<std::byte>(tid * 7 + 1));
  }

  void turns(int count = 8) { run_turns(loop, count); }

  // What came to the peer since this was asked last.
  std::vector<SentItem> take(FakePeer& peer, std::size_t payload_bytes = 0) {
    return decode(std::exchange(peer.sent, {}), payload_bytes);
  }
  // The one answer.
  net::Frame ask(FakePeer& peer, const net::Frame& request, std::size_t payload_bytes = 0) {
    peer.put(request);
    turns();
    const std::vector<SentItem> items = take(peer, payload_bytes);
    EXPECT_EQ(items.size(), 1u);
    if (items.empty()) return {};
    EXPECT_EQ(items[0].frame.serial(), request.serial());
    return items[0].frame;
  }

  EventLoop loop = *EventLoop::open();
  Registry registry{"pc1", kLimits};
  OpenTable opens{{100, 100}};
  LogRecorder logger;
  ChannelServer server;
};

}  // namespace dssm::daemon
