// SPDX-License-Identifier: Apache-2.0
//
// Arbitrary bytes from a network peer, after a Hello or with one of its own: through decoder and
// requests to the registry, its rings and the answers, in a real event loop. A second peer watches
// and subscribes, and a program writes, so that events, gaps and full sockets occur. An input's
// first three bytes choose the Hello and whether it has the feature "torn", how the peer's bytes
// are split, and how much it reads. Then comes a bomb (bomb.hpp), which is sent last.
#include <netinet/in.h>

#include <cstdlib>
#include <cstring>

#include "core/ring/ring_writer.hpp"
#include "daemon/serve/channel_server.hpp"
#include "tests/fuzz/bomb.hpp"
#include "tests/fuzz/fuzzer.hpp"
#include "tests/support/log_recorder.hpp"
#include "tests/support/memory_peer.hpp"
#include "tests/unit/daemon/run_loop.hpp"

namespace dssm::daemon {
namespace {

using namespace test;

wire::SocketAddress nowhere() {
  wire::SocketAddress address;
  sockaddr_in number{};
  number.sin_family = AF_INET;
  std::memcpy(&address.storage, &number, sizeof number);
  address.length = sizeof number;
  return address;
}

void run(std::span<const std::uint8_t> input) {
  if (input.size() < 3) return;
  const bool torn = input[0] & 1;
  const bool large = input[0] & 2;
  const bool greets = !(input[0] & 4);
  const std::size_t cut = 1U + input[1], room = input[2] * 100U;
  input = input.subspan(3);
  const Bytes bomb = to_bytes(fuzz::bomb_from(input));
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

  MemoryPeer watcher, fuzzed;
  const Rights rights;
  ChannelServer server({*loop, registry, opens, rights, logger}, greeting_of("pc1"),
                       {4, 4, 2U << 20});
  watcher.put(hello_frame(greeting_of("pc1", "watcher")));
  watcher.put(with_serial(1, open_frame("a")));
  watcher.put(with_serial(2, subscribe_from_oldest_frame()));
  fuzzed.max_receive_bytes = cut;
  const wire::Greeting greeting = greeting_of("pc1", "fuzzer");
  if (greets) fuzzed.put(hello_frame(torn ? greeting : without_features(greeting)));
  const auto bytes = std::as_bytes(input);
  fuzzed.put(Bytes(bytes.begin(), bytes.end()));
  fuzzed.put(bomb);
  for (MemoryPeer* peer : {&watcher, &fuzzed}) {
    if (!server.adopt(std::make_unique<MemoryTransport>(*peer), nowhere())) std::abort();
  }
  const auto turn = [&](std::size_t room) {
    fuzzed.room = room;
    watcher.room = 1U << 20;
    run_turns(*loop);
    fuzzed.sent.clear();
    watcher.sent.clear();
  };
  for (int i = 0; i < 2000 && !fuzzed.closed && fuzzed.has_input(); ++i) {
    program.write(payload, {}, Duration(1));
    turn(room);
  }
  fuzzed.drop_input();
  fuzzed.end();
  for (int i = 0; i < 2000 && !fuzzed.closed; ++i) turn(1U << 20);
  // That connection is closed, and the other one is not.
  if (!fuzzed.closed || watcher.closed) std::abort();
}

}  // namespace
}  // namespace dssm::daemon

void dssm::fuzz::run_input(std::span<const std::uint8_t> input) { dssm::daemon::run(input); }
