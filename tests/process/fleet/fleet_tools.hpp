// SPDX-License-Identifier: Apache-2.0
//
// What the tests of a fleet on loopback share.
#pragma once

#include <dssm/dssm.hpp>
#include <string>
#include <thread>
#include <vector>

#include "tests/support/daemon_process.hpp"

namespace dssm::test {

inline Session connect(const DaemonProcess& daemon) {
  return Session::connect(
             {.socket_path = daemon.socket_path(), .request_timeout = std::chrono::seconds(60)})
      .value();
}

// Looks again and again; the test runner's time limit is the watchdog.
template <class Condition>
void await(Condition condition) {
  while (!condition()) std::this_thread::yield();
}

// What `session`'s dssmd says about the peer at `address`.
inline HostInfo peer_at(Session& session, const std::string& address) {
  for (HostInfo& host : session.hosts().value()) {
    if (host.state != "self" && host.addresses.at(0) == address) return std::move(host);
  }
  return {};
}

inline void await_state(Session& session, const DaemonProcess& peer, const std::string& state) {
  await([&] { return peer_at(session, peer.address()).state == state; });
}

// All streams that `session` lists, as "lidar:0@pc2".
inline std::vector<std::string> names(const std::vector<StreamInfo>& streams) {
  std::vector<std::string> names;
  for (const StreamInfo& stream : streams) names.push_back(stream.id.str());
  return names;
}

inline void await_list(Session& session, const std::vector<std::string>& expected) {
  await([&] { return names(session.list().value()) == expected; });
}

inline constexpr History kHistory{16, std::chrono::milliseconds(10)};

}  // namespace dssm::test
