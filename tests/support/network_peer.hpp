// SPDX-License-Identifier: Apache-2.0
//
// One end of a real connection of the network protocol, scripted by a test: a client of a dssmd
// (NetworkPeer), or a dssmd for its clients (ScriptedDaemon). Both can send what no product code
// sends. Blocking; a wait of kNetworkPeerSeconds for the other end fails the test.
#pragma once

#include <atomic>
#include <functional>
#include <optional>
#include <string>
#include <string_view>
#include <thread>

#include "core/base/unique_fd.hpp"
#include "tests/support/frames.hpp"

namespace dssm::test {

inline constexpr int kNetworkPeerSeconds = 180;

class NetworkPeer {
 public:
  // Connects to "127.0.0.1:1234" from the calling thread's network namespace; sends nothing.
  explicit NetworkPeer(const std::string& address);
  // Over a connected socket.
  explicit NetworkPeer(UniqueFd socket);
  // Connected and greeted: a program of the host "peer", with the clock of this PC.
  static NetworkPeer greeted(const std::string& address, bool torn = true);

  int fd() const { return socket_.get(); }
  // Whether the connection succeeded and has not ended, as far as known.
  bool is_open() const { return socket_ && !ended_; }
  void close() { socket_.reset(); }

  // Sends all of it, blocking if necessary, unless the connection ends.
  void send(const net::Frame& frame);
  void send_bytes(std::string_view bytes);
  void send_sample(const SampleInfo& info, std::span<const std::byte> payload,
                   std::uint64_t serial = 0);

  // The next frame of any kind; nothing when the connection has ended.
  std::optional<net::Frame> try_receive();
  // The next frame; a connection that has ended fails the test.
  net::Frame receive();
  // Receives until the connection ends; returns the last frame, if any.
  std::optional<net::Frame> await_end();

  // --- as a client

  // Sends a Hello, and receives the answer. Returns the answer if it is not a Hello.
  std::optional<net::Frame> greet(bool torn = true);
  const proto::Hello& server() const { return server_; }
  // Sends the request with a new serial, and returns its answer; drops what comes before it, and
  // torn samples. Empty when the connection ended.
  net::Frame ask(net::Frame request);
  // Opens or creates a stream for this channel.
  proto::Opened open(const std::string& name);
  proto::Opened create(const std::string& name, std::uint64_t payload_bytes, std::uint64_t depth);
  // Receives until the connection ends; returns the message of the final failure.
  std::string final_failure();

  // --- as the dssmd of the host "fake"

  // Receives the client's Hello, and answers it.
  void answer_hello();
  // The same, then receives Open or Create, and answers it with a stream of samples of this size.
  // Returns the request.
  net::Frame answer_open(std::uint64_t payload_bytes, std::uint64_t incarnation = 1,
                         const std::string& type_name = "");
  // Receives Subscribe; its answer is that `first` comes first. Returns the request.
  net::Frame answer_subscribe(std::int64_t first, std::uint64_t incarnation = 1);
  // Receives a request and refuses it.
  void refuse(Errc code, const std::string& text);

 private:
  UniqueFd socket_;
  bool ended_ = false;
  FrameInput input_;
  proto::Hello server_;
  std::uint64_t serial_ = 0;
};

// The Hello of NetworkPeer as a client.
net::Frame client_hello_frame(std::uint32_t protocol_version = wire::kNetworkProtocolVersion,
                              bool torn = true);

// A dssmd that runs a script, in a thread of its own.
class ScriptedDaemon {
 public:
  // Called with each connection and its number, from 0; one connection after the other. When the
  // client or the test ends, try_receive() returns nothing.
  using Script = std::function<void(NetworkPeer&, int)>;

  explicit ScriptedDaemon(Script script, const std::string& address = "127.0.0.1:0");
  ScriptedDaemon(const ScriptedDaemon&) = delete;
  ScriptedDaemon& operator=(const ScriptedDaemon&) = delete;
  ~ScriptedDaemon();

  const std::string& address() const { return address_; }
  // How many runs of the script have ended.
  int ended() const { return ended_; }

 private:
  void serve(const Script& script);

  UniqueFd listener_;
  std::string address_;
  std::atomic<int> connected_{-1};
  std::atomic<int> ended_{0};
  std::atomic<bool> stop_{false};
  std::thread thread_;
};

}  // namespace dssm::test
