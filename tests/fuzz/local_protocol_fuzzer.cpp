// SPDX-License-Identifier: Apache-2.0
//
// Arbitrary bytes from a local client after its Hello: through the frame buffer, the decoding of
// requests, the registry and its real memory files to the answers. A second client watches and has
// a stream open, so that events and conflicts occur. Another host answers after the input, or after
// the client has disconnected. An input's first two bytes choose whether dssmd is recovering, which
// descriptors the client sends, and how its bytes are split. Then comes a bomb (bomb.hpp), which is
// sent last.
#include <fcntl.h>

#include <algorithm>
#include <cstdlib>
#include <cstring>

#include "core/wire/frame.hpp"
#include "core/wire/local_protocol.hpp"
#include "daemon/local/local_service.hpp"
#include "tests/fuzz/bomb.hpp"
#include "tests/fuzz/fuzzer.hpp"
#include "tests/fuzz/late_fleet.hpp"
#include "tests/support/log_recorder.hpp"

namespace dssm::daemon {
namespace {

// Receives all output, and checks that it consists of frames that clients accept.
class Sink final : public ClientOutput {
 public:
  void send(std::string bytes, std::vector<UniqueFd>) override {
    if (bytes.size() > wire::kMaxLocalFrameBytes + 10) std::abort();
  }
  void request_turn() override {}  // each has one after each frame
};

struct Daemon {
  explicit Daemon(bool recovering)
      : registry("pc1",
                 {.max_streams = 8, .max_memory_bytes = 1 << 20, .max_property_bytes = 4096}),
        opens({.max_opens = 16, .max_opens_per_client = 8}),
        service(registry, opens, clock, rights, logger, &fleet) {
    if (recovering) registry.begin_recovery(Registry::Recovery::streams);
  }
  LogRecorder logger;
  Registry registry;
  OpenTable opens;
  PlaybackClockOwner clock;
  const Rights rights;
  LateFleet fleet;
  LocalService service;
};

void put(Daemon& daemon, ClientNumber client, const local::Request& request) {
  const std::string bytes = request.SerializeAsString();
  DescriptorQueue none;
  daemon.service.on_frame_untrusted(client, std::as_bytes(std::span(bytes)), none);
}

void take_turns(Daemon& daemon, ClientNumber client) {
  while (daemon.service.go_on(client)) {
  }
}

local::Request hello() {
  local::Request request;
  request.set_serial(1);
  request.mutable_hello()->set_protocol_version(wire::kLocalProtocolVersion);
  return request;
}

// Descriptors of a stream "a" that an earlier dssmd had.
const std::vector<UniqueFd>& kept_descriptors() {
  static const std::vector<UniqueFd> kept = [] {
    Registry before("pc1",
                    {.max_streams = 1, .max_memory_bytes = 1 << 20, .max_property_bytes = 1});
    const auto created =
        before.create({"a", 0, ""}, {"T", 8, 8, {}}, {4, std::chrono::milliseconds(1)}, 1);
    if (!created) std::abort();
    return *created->stream->descriptors_for(Role::writer);
  }();
  return kept;
}

// Up to four of them, or other files, depending on `choice`.
std::vector<UniqueFd> descriptors(unsigned choice) {
  std::vector<UniqueFd> result;
  for (unsigned i = 0; i < choice % 5; ++i) {
    const unsigned which = choice & 8 ? (i + choice / 16) % 4 : i;
    result.emplace_back(::fcntl(kept_descriptors()[which].get(), F_DUPFD_CLOEXEC, 0));
  }
  return result;
}

void run(std::span<const std::uint8_t> input) {
  if (input.size() < 2) return;
  const unsigned control = input[0], cut = 1 + input[1];
  input = input.subspan(2);
  const std::string bomb = fuzz::bomb_from(input);
  Daemon daemon(control & 1);
  Sink sink;
  const ClientNumber watcher = daemon.service.connect({}, sink);
  put(daemon, watcher, hello());
  local::Request watch;
  watch.set_serial(2);
  watch.mutable_watch();
  put(daemon, watcher, watch);
  const ClientNumber client = daemon.service.connect({}, sink);
  put(daemon, client, hello());

  DescriptorQueue arrived;
  if (control & 2) arrived.push_back(descriptors(control / 4));
  if (control & 4) arrived.push_back(descriptors(3));
  wire::FrameBuffer buffer(wire::kMaxLocalFrameBytes);
  bool goes_on = true;
  const auto receive = [&](std::span<const std::byte> bytes, std::size_t at_most) {
    while (goes_on && !bytes.empty()) {
      const auto space = buffer.space();
      const std::size_t part = std::min({space.size(), bytes.size(), at_most});
      std::memcpy(space.data(), bytes.data(), part);
      buffer.commit(part);
      bytes = bytes.subspan(part);
      while (goes_on) {
        const auto frame = buffer.next();
        goes_on = frame.has_value();
        if (!frame || !*frame) break;
        goes_on = daemon.service.on_frame_untrusted(client, **frame, arrived);
        take_turns(daemon, client);
        take_turns(daemon, watcher);
      }
    }
  };
  receive(std::as_bytes(input), cut);
  receive(std::as_bytes(std::span(bomb)), SIZE_MAX);
  daemon.registry.end_recovery();
  take_turns(daemon, client);
  take_turns(daemon, watcher);
  if (cut & 1) daemon.fleet.answer();
  daemon.service.disconnect(client);
  daemon.fleet.answer();
  if (!daemon.opens.entries().empty()) std::abort();
}

}  // namespace
}  // namespace dssm::daemon

void dssm::fuzz::run_input(std::span<const std::uint8_t> input) { dssm::daemon::run(input); }
