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
#include "tests/support/memory_peer.hpp"
#include "tests/unit/daemon/daemon_fixtures.hpp"
#include "tests/unit/daemon/run_loop.hpp"

namespace dssm::daemon {

using namespace test;

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

class ServerRig {
 public:
  explicit ServerRig(const PeerTable::Limits& limits = {16, 8, 32U << 20},
                     ClockAssessor* clock = nullptr, const Rights* rights = nullptr)
      : server({loop, registry, opens, rights ? *rights : no_rights, logger, clock,
                [this](const wire::Greeting& them, const auto& returned) {
                  if (on_heartbeat) on_heartbeat(them, returned);
                },
                false,
                [this](const wire::SocketAddress& from, const wire::CertifiedPeer*) {
                  return from.str() == configured;
                }},
               greeting_with(own_clock), limits) {}

  // Connects; without `greet` it says nothing. The peer outlives the rig's use of it.
  void connect(MemoryPeer& peer, bool greet = true, bool torn = true, std::uint32_t host = 2,
               const std::string& program = "test") {
    const Result<void> adopted =
        server.adopt(std::make_unique<MemoryTransport>(peer), address_of(host));
    ASSERT_TRUE(adopted) << adopted.error().message;
    if (!greet) return;
    const wire::Greeting greeting = greeting_of("pc" + std::to_string(host), program);
    peer.put(hello_frame(torn ? greeting : without_features(greeting)));
    turns();
    const std::vector<net::Frame> frames = peer.take();
    ASSERT_EQ(frames.size(), 1u);
    EXPECT_EQ(frames[0].hello().host(), "pc1");
  }
  void open(MemoryPeer& peer, const std::string& name) {
    const net::Frame answer = ask(peer, with_serial(1000, open_frame(name)));
    ASSERT_TRUE(answer.has_opened()) << answer.failure().message();
  }

  std::shared_ptr<Stream> create(const std::string& name, std::uint64_t payload_bytes = 24,
                                 std::uint64_t depth = 16) {
    TypeInfo type{"", payload_bytes, 8, {}};
    const Result<OpenedRing> created =
        registry.create({name, 0, ""}, type, {depth, std::chrono::milliseconds(10)}, 42);
    EXPECT_TRUE(created) << created.error().message;
    return created ? created->stream : nullptr;
  }
  // As a program of this PC writes; the sample with tid 0 has the time `first`.
  void write(Stream& stream, int count = 1, Time first = time_from_ns(1000)) {
    const OfferedFiles files = as_offer(stream.descriptors_for(Role::writer).value());
    const auto mapping =
        ring::RingMapping::open_untrusted(files.ring.get(), ring::Access::read_write).value();
    const auto bell = ring::Bell::open_untrusted(files.bell.get()).value();
    ring::RingWriter writer(*mapping, *bell, files.doorbell.get());
    for (int i = 0; i < count; ++i) {
      const Tid tid = writer.newest() + 1;
      writer.write(payload_for(tid, stream.type().payload_bytes), first + Duration(tid * 10),
                   Duration(3));
    }
  }
  static Bytes payload_for(Tid tid, std::uint64_t bytes) {
    return Bytes(bytes, static_cast<std::byte>(tid * 7 + 1));
  }

  void turns(int count = 8) { run_turns(loop, count); }

  // The one answer.
  net::Frame ask(MemoryPeer& peer, const net::Frame& request) {
    peer.put(request);
    turns();
    const std::vector<net::Frame> frames = peer.take();
    EXPECT_EQ(frames.size(), 1u);
    if (frames.empty()) return {};
    EXPECT_EQ(frames[0].serial(), request.serial());
    return frames[0];
  }

  static wire::Greeting greeting_with(std::shared_ptr<const wire::ClockReport> clock) {
    wire::Greeting greeting = greeting_of("pc1");
    greeting.clock = std::move(clock);
    return greeting;
  }

  std::string configured;  // address of a configured peer; empty: none
  std::function<void(const wire::Greeting&, const std::optional<clock::HeartbeatTimes>&)>
      on_heartbeat;
  // What it reports of its clock.
  const std::shared_ptr<wire::ClockReport> own_clock = std::make_shared<wire::ClockReport>();
  EventLoop loop = *EventLoop::open(TimerQueue::Time::simulated);
  Registry registry{"pc1", kLimits};
  OpenTable opens{{100, 100}};
  const Rights no_rights;  // every program and host may do everything
  LogRecorder logger;
  ChannelServer server;
};

}  // namespace dssm::daemon
