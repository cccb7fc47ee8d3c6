// SPDX-License-Identifier: Apache-2.0
//
// Arbitrary bytes from a network peer after its Hello: through decoder and requests to the
// registry, its rings and the answers, in a real event loop. A second peer watches and subscribes,
// and a program writes, so that events, gaps and full sockets occur. An input's first three bytes
// choose whether the peer has the feature "torn", how its bytes are split, and how much it reads.
#include <event2/event.h>
#include <netinet/in.h>
#include <sys/eventfd.h>
#include <unistd.h>

#include <algorithm>
#include <cstdlib>
#include <cstring>

#include "core/ring/ring_writer.hpp"
#include "core/wire/frame.hpp"
#include "daemon/serve/channel_server.hpp"
#include "daemon/service/process.hpp"
#include "tests/support/log_recorder.hpp"

namespace dssm::daemon {
namespace {

// The input and output of a transport in this file.
struct Peer {
  std::string input;
  std::size_t cut = 1;  // bytes of one receive
  std::size_t space = 1U << 20;
  bool input_ended = false;
  bool closed = false;
};

// Always readable and writable.
class PeerTransport final : public wire::Transport {
 public:
  explicit PeerTransport(Peer& peer) : peer_(peer), fd_(::eventfd(1, EFD_CLOEXEC)) {}
  ~PeerTransport() override { peer_.closed = true; }

  Result<wire::IoResult> send(std::span<const iovec> parts) override {
    std::size_t bytes = 0;
    for (const iovec& part : parts) bytes += part.iov_len;
    bytes = std::min(bytes, peer_.space);
    peer_.space -= bytes;
    return wire::IoResult{bytes > 0 ? wire::IoStatus::ok : wire::IoStatus::would_block, bytes};
  }
  Result<wire::IoResult> receive(std::span<const iovec> spaces) override {
    if (peer_.input.empty()) {
      return wire::IoResult{peer_.input_ended ? wire::IoStatus::end : wire::IoStatus::would_block,
                            0};
    }
    const std::size_t bytes = std::min({peer_.input.size(), peer_.cut, spaces[0].iov_len});
    std::memcpy(spaces[0].iov_base, peer_.input.data(), bytes);
    peer_.input.erase(0, bytes);
    return wire::IoResult{wire::IoStatus::ok, bytes};
  }
  int fd() const noexcept override { return fd_.get(); }

 private:
  Peer& peer_;
  UniqueFd fd_;
};

wire::Greeting greeting(const char* program, bool torn) {
  wire::Greeting greeting;
  greeting.host = "pc1";
  greeting.program = program;
  if (torn) greeting.features.emplace_back(wire::kFeatureTorn);
  return greeting;
}

std::string hello(bool torn) {
  net::Frame frame;
  wire::to_message(greeting("fuzzer", torn), *frame.mutable_hello());
  return wire::encode_frame(frame);
}

std::string numbered(net::Frame frame, std::uint64_t serial) {
  frame.set_serial(serial);
  return wire::encode_frame(frame);
}

wire::SocketAddress nowhere() {
  wire::SocketAddress address;
  sockaddr_in number{};
  number.sin_family = AF_INET;
  std::memcpy(&address.storage, &number, sizeof number);
  address.length = sizeof number;
  return address;
}

// Runs due events.
void turn(const EventLoop& loop) { event_base_loop(loop.base(), EVLOOP_ONCE | EVLOOP_NONBLOCK); }

void run(std::span<const std::uint8_t> input) {
  if (input.size() < 3) return;
  const bool torn = input[0] & 1;
  const bool large = input[0] & 2;
  Result<EventLoop> loop = EventLoop::open();
  if (!loop) std::abort();
  LogRecorder logger;
  Registry registry("pc1",
                    {.max_streams = 8, .max_memory_bytes = 4U << 20, .max_property_bytes = 4096});
  OpenTable opens({.max_opens = 16, .max_opens_per_client = 8});
  const std::uint64_t payload_bytes = large ? 100'000 : 8;
  const auto created = registry.create({"a", 0, ""}, {"T", payload_bytes, 8, {}},
                                       {4, std::chrono::milliseconds(1)}, 1);
  if (!created) std::abort();
  const auto mapping = created->stream->map_for_writing();
  const auto bell = created->stream->map_bell();
  if (!mapping || !bell) std::abort();
  const auto doorbell = created->stream->descriptors_for(Role::writer);
  if (!doorbell) std::abort();
  ring::RingWriter program(**mapping, **bell, doorbell->at(3).get());
  const std::vector<std::byte> payload(payload_bytes);

  Peer watcher, fuzzed;
  ChannelServer server({*loop, registry, opens, logger}, greeting("dssmd", true), {4, 4, 2U << 20});
  net::Frame open, subscribe;
  open.mutable_open()->mutable_id()->set_name("a");
  subscribe.mutable_subscribe()->set_from_oldest(true);
  watcher.cut = 1000;
  watcher.input = hello(true) + numbered(open, 1) + numbered(subscribe, 2);
  fuzzed.cut = 1U + input[1];
  fuzzed.input = hello(torn) + std::string(input.begin() + 3, input.end());
  for (Peer* peer : {&watcher, &fuzzed}) {
    if (!server.adopt(std::make_unique<PeerTransport>(*peer), nowhere())) std::abort();
  }
  const auto step = [&] {
    program.write(payload, {}, Duration(1));
    fuzzed.space = input[2] * 100U;
    watcher.space = 1U << 20;
    turn(*loop);
  };
  for (int i = 0; i < 2000 && !fuzzed.closed && !fuzzed.input.empty(); ++i) step();
  fuzzed.input_ended = true;
  fuzzed.input.clear();
  for (int i = 0; i < 2000 && !fuzzed.closed; ++i) {
    fuzzed.space = 1U << 20;
    turn(*loop);
  }
  // This connection is closed, and the other one is not.
  if (!fuzzed.closed || watcher.closed) std::abort();
}

}  // namespace
}  // namespace dssm::daemon

extern "C" int LLVMFuzzerInitialize(int*, char***) {
  dssm::daemon::silence_protobuf();
  return 0;
}

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size) {
  dssm::daemon::run({data, size});
  return 0;
}
