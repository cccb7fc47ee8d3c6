// SPDX-License-Identifier: Apache-2.0
//
// 100 streams that are read on another host and not written: how often the two dssmd wake up,
// compared with the heartbeats of one control connection, which are the only allowed reason.
#include <dssm/dssm.hpp>
#include <string>

#include "tests/bench/harness.hpp"
#include "tests/bench/hosts.hpp"

using namespace dssm;
using namespace dssm::bench;
using namespace std::chrono_literals;

int main() {
  constexpr int kStreams = 100, kSeconds = 10;
  const Hosts hosts;
  const auto owner = hosts.start_owner(), other = hosts.start_other(*owner);
  Session session = Session::connect({.socket_path = owner->socket_path()}).value();
  Session there = Session::connect({.socket_path = other->socket_path()}).value();
  std::vector<RawWriter> writers;
  std::vector<RawReader> readers;
  for (int i = 0; i < kStreams; ++i) {
    const StreamId id{"idle", i, "pc1"};
    writers.push_back(session.create_raw(id, {"", 64, 1, {}}, History{100, 10ms}).value());
    readers.push_back(there.await_raw_reader(id, deadline_in(10s)).value());
  }
  ::sleep(1);
  const std::int64_t owner_before = sleeps_of(owner->pid()), other_before = sleeps_of(other->pid());
  ::sleep(kSeconds);
  const double owner_rate = static_cast<double>(sleeps_of(owner->pid()) - owner_before) / kSeconds;
  const double other_rate = static_cast<double>(sleeps_of(other->pid()) - other_before) / kSeconds;
  std::printf("100 remote streams, without writers      wake-ups a second  heartbeats\n");
  std::printf("  owner: a Ping a second arrives         %17.1f  1\n", owner_rate);
  std::printf("  mirrors: sends it, and gets the Pong   %17.1f  2\n", other_rate);
}
