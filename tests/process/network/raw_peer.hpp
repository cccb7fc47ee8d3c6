// SPDX-License-Identifier: Apache-2.0
//
// One end of a TCP connection to a dssmd. Tests can send invalid messages, and messages are decoded
// with stock protobuf. Blocking; a test fails if dssmd does not answer for kPatienceSeconds.
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
  // Connects from the calling thread's namespace.
  explicit RawPeer(const std::string& address, int port = kPort);
  // Takes ownership of a connected socket.
  explicit RawPeer(UniqueFd socket);

  // Whether the connection succeeded and has not ended, as far as known.
  bool is_open() const { return static_cast<bool>(socket_); }

  // Sends all of it, blocking if necessary, unless the connection ends.
  void send(const net::Frame& frame);
  void send_bytes(std::string_view bytes);

  // The next frame of any kind; nothing when the connection ended.
  std::optional<net::Frame> receive();

  // Reads until the connection ends; returns the last frame, if any.
  std::optional<net::Frame> await_end();

  // Sends the Hello of a program of the host "raw", and reads the answer. Returns the answer if it
  // is not a Hello.
  std::optional<net::Frame> greet(const std::vector<std::string>& features = {});

 private:
  UniqueFd socket_;
  std::string input_;  // received bytes that receive() has not returned yet
};

net::Frame hello_frame(std::uint32_t protocol_version = 1,
                       const std::vector<std::string>& features = {});
net::Frame open_frame(std::uint64_t serial, const std::string& stream);
net::Frame subscribe_from_oldest_frame(std::uint64_t serial);

// A socket that listens at `address` in the calling thread's namespace.
UniqueFd listen_at(const std::string& address, int port = kPort);
// The next connection to it.
RawPeer accept_peer(const UniqueFd& listener);

}  // namespace dssm::test
