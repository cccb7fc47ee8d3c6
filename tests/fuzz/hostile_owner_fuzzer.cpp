// SPDX-License-Identifier: Apache-2.0
//
// Arbitrary bytes from the dssmd of another host to which this one has connected: to its control
// connection, to a mirror, or to a remote writer, whose programs read and write meanwhile. Over
// TCP, in simulated time. An input's first byte chooses which of them, and whether the host greets.
// Then comes a bomb (bomb.hpp), which is sent last, and a list of steps: 1 byte that says what
// happens, and for bytes of the host their number, 1 byte, and the bytes.
#include <sys/socket.h>

#include <algorithm>
#include <cstdlib>
#include <memory>

#include "core/ring/ring_reader.hpp"
#include "core/ring/ring_writer.hpp"
#include "core/wire/tcp.hpp"
#include "daemon/fleet/peers.hpp"
#include "daemon/remote/mirror.hpp"
#include "daemon/remote/remote_streams.hpp"
#include "daemon/remote/remote_writer.hpp"
#include "tests/fuzz/bomb.hpp"
#include "tests/fuzz/fuzzer.hpp"
#include "tests/support/frames.hpp"
#include "tests/support/log_recorder.hpp"
#include "tests/unit/daemon/run_loop.hpp"

namespace dssm::daemon {
namespace {

using namespace test;

const StreamId kStream{"a", 0, "pc2"};

// The other host: one connection at a time, of which it reads nothing that matters.
class HostileOwner {
 public:
  HostileOwner(const EventLoop& loop, bool greets) : loop_(loop), greets_(greets) {
    const wire::Address any = wire::Address::parse("127.0.0.1:0", 0, true).value();
    listening_ = wire::listen_tcp(wire::resolve_number(any).at(0)).value();
    host_.greeting = greeting_of("pc2");
    host_.greeting.features.emplace_back(wire::kFeatureNewestFirst);
    host_.greeting.features.emplace_back(wire::kFeatureClock);
    host_.greeting.features.emplace_back(wire::kFeatureUsers);
    host_.address =
        wire::Address::parse(wire::local_address(listening_.get()).value().str()).value();
  }
  HostileOwner(const HostileOwner&) = delete;
  HostileOwner& operator=(const HostileOwner&) = delete;
  ~HostileOwner() { cut(); }

  const KnownHost& host() const { return host_; }

  void turn() {
    run_turns(loop_, 2);
    if (!connection_) accept_one();
    std::byte bytes[4096];
    while (connection_ && ::recv(connection_.get(), bytes, sizeof bytes, MSG_DONTWAIT) > 0) {
    }
  }
  void send(std::span<const std::byte> bytes) {
    for (int turns = 0; turns < 100 && connection_ && !bytes.empty(); ++turns) {
      const ssize_t sent =
          ::send(connection_.get(), bytes.data(), bytes.size(), MSG_DONTWAIT | MSG_NOSIGNAL);
      if (sent > 0) bytes = bytes.subspan(static_cast<std::size_t>(sent));
      turn();
    }
  }
  // Without the wait for the last packets, which would keep the port.
  void cut() {
    if (!connection_) return;
    const linger at_once{1, 0};
    ::setsockopt(connection_.get(), SOL_SOCKET, SO_LINGER, &at_once, sizeof at_once);
    connection_.reset();
  }

 private:
  void accept_one() {
    connection_.reset(::accept4(listening_.get(), nullptr, nullptr, SOCK_NONBLOCK | SOCK_CLOEXEC));
    if (!connection_ || !greets_) return;
    const Bytes hello = to_bytes(hello_frame(host_.greeting));
    if (::send(connection_.get(), hello.data(), hello.size(), MSG_NOSIGNAL) < 0) std::abort();
    run_turns(loop_, 2);
  }

  const EventLoop& loop_;
  const bool greets_;
  KnownHost host_;
  UniqueFd listening_, connection_;
};

// This host. Which of the connections it has is up to the input.
struct Host {
  Host() {
    parts.self.features.emplace_back(wire::kFeatureNewestFirst);
    parts.opens = &opens;
  }
  EventLoop loop = EventLoop::open(TimerQueue::Time::simulated).value();
  Resolver resolver{loop};
  Registry registry{"pc1",
                    {.max_streams = 8, .max_memory_bytes = 4U << 20, .max_property_bytes = 4096}};
  OpenTable opens{{8, 8}};
  LogRecorder logger;
  Catalog catalog{"pc1"};
  ChannelParts parts{loop, resolver, registry, logger, greeting_of("pc1")};
};

// Programs of this host that use a stream of the other one: what a step lets them do.
template <class Kind>
class Programs {
 public:
  Programs(Host& host, const HostileOwner& owner)
      : host_(host), owner_(owner), streams_(host.parts, host.catalog) {
    host.catalog.host_up(owner.host().greeting, owner.host().address);
  }

  void step(unsigned what) {
    switch (what % 8) {
      case 0:
        return open(nullptr);
      case 1:
        return open(&plan_);
      case 2:
        rings_.clear();
        return;
      case 3:
        use_rings();
        return;
      case 4:
        return host_.catalog.stream_removed(owner_.host().greeting.host_id, owned_id());
      case 5:
        return add(what / 8);
      case 6:
        return want_history(what & 8);
      default:
        host_.catalog.host_down(owner_.host().greeting.host_id, {Errc::unavailable, "a test"});
        host_.catalog.host_up(owner_.host().greeting, owner_.host().address);
    }
  }

 private:
  static StreamId owned_id() { return {kStream.name, kStream.id, ""}; }

  void open(const CreatePlan* plan) {
    if (rings_.size() > 8) return;
    streams_.open(owner_.host(), kStream, plan, [this](Result<OpenedRing> ring) {
      if (ring) rings_.push_back(std::move(ring->stream));
    });
  }
  void add(std::uint64_t incarnation) {
    StreamInfo stream;
    stream.id = kStream;
    stream.type = plan_.type;
    stream.incarnation = incarnation;
    static_cast<void>(
        host_.catalog.stream_added(owner_.host().greeting.host_id, std::move(stream)));
  }
  void want_history(bool while_held) {
    if constexpr (std::is_same_v<Kind, Mirror>) {
      Mirror* mirror = streams_.find(kStream);
      if (!mirror) return;
      if (!while_held) return mirror->want_history();
      if (!rings_.empty()) rings_.back() = mirror->with_history(rings_.back());
    }
  }
  void use_rings() {
    for (const std::shared_ptr<Stream>& stream : rings_) {
      if constexpr (std::is_same_v<Kind, Mirror>) {
        read(stream->mapping());
      } else {
        write(*stream);
      }
    }
  }
  static void read(const ring::RingMapping& mapping) {
    const ring::RingReader reader(mapping);
    std::vector<std::byte> payload(mapping.geometry().payload_bytes);
    SampleInfo info;
    static_cast<void>(reader.read_newest(payload, info));
    const Tid newest = reader.newest();
    for (Tid tid = std::max(reader.oldest(), newest - 16); tid <= newest; ++tid) {
      static_cast<void>(reader.read(tid, payload, info));
    }
    Tid found = 0;
    static_cast<void>(reader.find(time_from_ns(1000), found));
  }
  static void write(Stream& stream) {
    const auto mapping = stream.map_for_writing();
    const auto bell = stream.map_bell();
    const auto descriptors = stream.descriptors_for(Role::writer);
    if (!mapping || !bell || !descriptors) std::abort();
    ring::RingWriter writer(**mapping, **bell, descriptors->at(3).get());
    const std::vector<std::byte> payload((*mapping)->geometry().payload_bytes);
    for (int i = 0; i < 3; ++i) writer.write(payload, time_from_ns(1000 + i), Duration(1));
  }

  Host& host_;
  const HostileOwner& owner_;
  CreatePlan plan_{{"T", 8, 8, {}}, {4, std::chrono::milliseconds(1)}};
  std::vector<std::shared_ptr<Stream>> rings_;
  RemoteStreams<Kind> streams_;
};

// The control connection, and what is known by it.
class Control {
 public:
  Control(Host& host, const HostileOwner& owner)
      : host_(host),
        peers_(host.loop, host.resolver, {owner.host().address}, host.parts.self, host.catalog,
               host.logger) {}

  void step(unsigned what) {
    PeerConnection* connection = peers_.connection_to(wire::host_id_for("pc2"));
    if (what % 8 == 0) peers_.on_network_changed();
    if (!connection) return;
    net::Frame request;
    switch (what % 8) {
      case 1:
        request.mutable_list();
        break;
      case 2:
        request.mutable_info()->mutable_id()->set_name("a");
        break;
      case 3:
        request.mutable_list_clock_pairs();
        break;
      case 4:
        request.mutable_list_nodes();
        break;
      default:
        request.mutable_get_property()->mutable_id()->set_name("a");
    }
    connection->ask(std::move(request), [](const Result<net::Frame>&) {});
    static_cast<void>(host_.catalog.find_owner(kStream));
  }

 private:
  Host& host_;
  Peers peers_;
};

template <class Subject>
void run_steps(Host& host, HostileOwner& owner, std::span<const std::uint8_t> input,
               std::span<const std::byte> bomb) {
  Subject subject(host, owner);
  subject.step(0);
  for (int i = 0; i < 4; ++i) owner.turn();
  for (int steps = 0; steps < 500 && !input.empty(); ++steps) {
    const unsigned what = input[0];
    input = input.subspan(1);
    switch (what % 4) {
      case 0:
      case 1: {
        const std::size_t length =
            input.empty() ? 0 : std::min<std::size_t>(input[0], input.size() - 1);
        if (!input.empty()) owner.send(std::as_bytes(input.subspan(1, length)));
        input = input.subspan(std::min(length + 1, input.size()));
        break;
      }
      case 2:
        subject.step(what / 4);
        break;
      default:
        if (what & 4) owner.cut();
        host.loop.timers().run_next();
    }
    owner.turn();
  }
  owner.send(bomb);
  for (int i = 0; i < 8; ++i) owner.turn();
}

void run(std::span<const std::uint8_t> input) {
  if (input.empty()) return;
  const unsigned choice = input[0];
  input = input.subspan(1);
  const std::string bomb = fuzz::bomb_from(input);
  const auto last = std::as_bytes(std::span(bomb));
  Host host;
  HostileOwner owner(host.loop, !(choice & 4));
  switch (choice % 4) {
    case 0:
      return run_steps<Control>(host, owner, input, last);
    case 1:
      return run_steps<Programs<RemoteWriter>>(host, owner, input, last);
    default:
      return run_steps<Programs<Mirror>>(host, owner, input, last);
  }
}

}  // namespace
}  // namespace dssm::daemon

void dssm::fuzz::run_input(std::span<const std::uint8_t> input) { dssm::daemon::run(input); }
