// SPDX-License-Identifier: Apache-2.0
//
// Arbitrary bytes from a dssmd to a program that connects to it with a PConnector, whose calls run
// meanwhile. Over TCP, in real time, so the calls wait only briefly. An input is
//
//   1 byte  1: the dssmd greets, 2: it opens the stream
//   steps   their number, 1 byte; 1 byte for each call
//   bomb    (bomb.hpp), which is sent last
//   parts   what is sent: 1 byte, which says whether the dssmd waits for a request before, or ends
//           the connection instead; their number, 1 byte; the bytes. The program connects again
//           when a connection has ended
#include <sys/socket.h>

#include <algorithm>
#include <cstdlib>
#include <dssm/pconnector.hpp>
#include <string>
#include <utility>
#include <vector>

#include "tests/fuzz/bomb.hpp"
#include "tests/fuzz/fuzzer.hpp"
#include "tests/support/network_peer.hpp"

namespace dssm {
namespace {

using namespace std::chrono_literals;
using namespace test;

constexpr Duration kRequestTimeout = 50ms, kWait = 20ms;
constexpr int kMaxConnections = 4;
constexpr std::size_t kMaxSteps = 16;
constexpr std::size_t kMaxPayloadBytes = 1U << 20;

// What the dssmd does on all connections, one after another.
struct Script {
  bool greets = false, opens = false;
  std::span<const std::uint8_t> parts;
  std::string_view bomb;

  void run(NetworkPeer& peer, int number) {
    if (number >= kMaxConnections) return;
    if (greets && peer.try_receive()) peer.send(hello_frame(greeting_of("pc2")));
    if (opens) {
      StreamInfo stream;
      stream.id = {"a", 0, "pc2"};
      stream.type = {"T", 8, 8, {}};
      stream.depth = 4;
      stream.cycle = 1ms;
      stream.incarnation = static_cast<std::uint64_t>(number + 1);
      if (const auto request = peer.try_receive()) peer.send(opened_frame(*request, stream));
    }
    while (parts.size() >= 2) {
      const unsigned what = parts[0] % 4;
      const std::size_t length = std::min<std::size_t>(parts[1], parts.size() - 2);
      const auto part = parts.subspan(2, length);
      parts = parts.subspan(2 + length);
      if (what == 0) return end(peer);
      if (what > 1) peer.try_receive();
      peer.send_bytes({reinterpret_cast<const char*>(part.data()), part.size()});
    }
    peer.send_bytes(std::exchange(bomb, {}));
    end(peer);
  }

 private:
  // Waits until the program has closed it: what was sent would be lost with it.
  static void end(NetworkPeer& peer) {
    ::shutdown(peer.fd(), SHUT_WR);
    while (peer.try_receive()) {
    }
  }
};

// Calls of a program; they may fail.
class Program {
 public:
  explicit Program(PConnector& connector)
      : connector_(connector), payload_(connector.payload_bytes()) {}

  void step(unsigned what) {
    switch (what % 10) {
      case 0:
        return use(connector_.subscribe({.start = Subscription::Start::oldest}));
      case 1:
        return read_next();
      case 2:
        return use(connector_.read_newest(payload_, info_));
      case 3:
        return use(connector_.set_property(payload_));
      case 4:
        return use(connector_.property());
      case 5:
        return use(connector_.post(payload_, time_from_ns(1000), Duration(1)));
      case 6:
        return use(connector_.flush(kWait));
      case 7:
        return use(connector_.newest_tid());
      case 8:
        return use(connector_.find(time_from_ns(1000)));
      default:
        return use(connector_.unsubscribe());
    }
  }

 private:
  template <class Outcome>
  static void use(const Outcome&) {}
  void read_next() {
    use(connector_.wait(kWait));
    for (int i = 0; i < 8; ++i) {
      const auto status = connector_.read_next(payload_, info_);
      if (!status || *status == ReadStatus::not_yet) return;
      if (*status == ReadStatus::ok && info_.payload_bytes > payload_.size()) std::abort();
    }
  }

  PConnector& connector_;
  std::vector<std::byte> payload_;
  SampleInfo info_;
};

void run(std::span<const std::uint8_t> input) {
  if (input.size() < 2) return;
  Script script{(input[0] & 1) != 0, (input[0] & 2) != 0, {}, {}};
  const auto steps =
      input.subspan(2, std::min<std::size_t>(input[1] % kMaxSteps, input.size() - 2));
  input = input.subspan(2 + steps.size());
  const std::string bomb = fuzz::bomb_from(input);
  script.bomb = bomb;
  script.parts = input;
  const ScriptedDaemon dssmd([&](NetworkPeer& peer, int number) { script.run(peer, number); });
  Result<PConnector> connector = PConnector::open(
      {"a", 0, ""},
      {.address = dssmd.address(), .program = "viewer", .request_timeout = kRequestTimeout});
  if (!connector || connector->payload_bytes() > kMaxPayloadBytes) return;
  fuzz::count_bytes(connector->payload_bytes());
  Program program(*connector);
  for (const std::uint8_t what : steps) program.step(what);
}

}  // namespace
}  // namespace dssm

void dssm::fuzz::run_input(std::span<const std::uint8_t> input) { dssm::run(input); }
