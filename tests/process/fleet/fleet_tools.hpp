// SPDX-License-Identifier: Apache-2.0
//
// What the tests of a fleet on loopback share.
#pragma once

#include <algorithm>
#include <dssm/dssm.hpp>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "tests/support/await.hpp"
#include "tests/support/daemon_process.hpp"
#include "tests/support/session.hpp"

namespace dssm::test {

// What `session`'s dssmd says about the peer at `address`.
inline HostInfo peer_at(Session& session, const std::string& address) {
  for (HostInfo& host : session.list_hosts().value()) {
    if (host.state != HostState::self && host.addresses.at(0) == address) return std::move(host);
  }
  return {};
}

inline void await_up(Session& session, const std::string& host) {
  await([&] {
    const std::vector<HostInfo> hosts = session.list_hosts().value();
    return std::any_of(hosts.begin(), hosts.end(), [&](const HostInfo& one) {
      return one.name == host && one.state == HostState::up;
    });
  });
}

inline void await_state(Session& session, const DaemonProcess& peer, HostState state) {
  await([&] { return peer_at(session, peer.address()).state == state; });
}

// A reader of a stream of another host, once its mirror is filled: on a busy machine opening gives
// up waiting for the other dssmd or for the history, or the other one is taken for dead.
template <class T>
Reader<T> open_filled(Session& session, const std::string& stream) {
  std::optional<Reader<T>> reader;
  await([&] {
    Result<Reader<T>> opened = session.open_reader<T>(stream, FetchHistory::at_once);
    if (opened) {
      reader = *std::move(opened);
    } else if (opened.error().code != Errc::unavailable && opened.error().code != Errc::not_found) {
      opened.value();  // throws, with the reason
    }
    return reader.has_value();
  });
  await([&] {
    const Result<StreamInfo> info = session.stream_info(reader->id());
    return info && info->mirror && info->mirror->state == MirrorState::live;
  });
  return *std::move(reader);
}

// All streams that `session` lists, as "lidar:0@pc2".
inline std::vector<std::string> names(const std::vector<StreamInfo>& streams) {
  std::vector<std::string> names;
  for (const StreamInfo& stream : streams) names.push_back(stream.id.str());
  return names;
}

inline void await_list(Session& session, const std::vector<std::string>& expected) {
  await([&] { return names(session.list_streams().value()) == expected; });
}

inline constexpr History kHistory{16, std::chrono::milliseconds(10)};

}  // namespace dssm::test
