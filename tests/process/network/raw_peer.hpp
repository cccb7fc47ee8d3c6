// SPDX-License-Identifier: Apache-2.0
//
// One end of a TCP connection to a dssmd, spoken by hand: what well-behaved programs would not say
// can be said, and what was promised is read with stock protobuf. Blocking; a test whose dssmd
// stays silent for kPatienceSeconds fails.
#pragma once

#include <optional>
#include <string>
#include <string_view>
#include <vector>

#include "core/base/unique_fd.hpp"
#include "network.pb.h"

namespace dssm::test {

inline constexpr int kPatienceSeconds = 180;
inline constexpr int kPort = 13776;

class RawPeer {
 public:
  // Connects from the namespace that the calling thread is inside of.
  explicit RawPeer(const std::string& address, int port = kPort);
  // Takes a connected socket over.
  explicit RawPeer(UniqueFd socket);

  // Whether connecting succeeded and the connection has not been seen to end.
  bool is_open() const { return static_cast<bool>(socket_); }

  // Sends all of it, waiting while the other side takes nothing, unless the connection ends before.
  void send(const net::Frame& frame);
  void send_bytes(std::string_view bytes);

  // The next frame of any kind; nothing when the connection ended.
  std::optional<net::Frame> receive();

  // Reads on until the connection ends; the last frame of all, if there was one.
  std::optional<net::Frame> await_end();

  // Says Hello as a program of a host "raw" does, and takes the answer's Hello. What came instead
  // of it, if anything, is returned.
  std::optional<net::Frame> greet(const std::vector<std::string>& features = {});

 private:
  UniqueFd socket_;
  std::string input_;  // what arrived and is not handed out yet
};

net::Frame hello_frame(std::uint32_t protocol_version = 1,
                       const std::vector<std::string>& features = {});
net::Frame open_frame(std::uint64_t serial, const std::string& stream);
net::Frame subscribe_from_oldest_frame(std::uint64_t serial);

// A socket that listens at `address` in the namespace that the calling thread is inside of.
UniqueFd listen_at(const std::string& address, int port = kPort);
// The next connection to it.
RawPeer accept_peer(const UniqueFd& listener);

}  // namespace dssm::test
