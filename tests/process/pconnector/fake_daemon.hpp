// SPDX-License-Identifier: Apache-2.0
//
// The other end of a PConnector as a script: a thread of the test that says what a dssmd says, or
// what none should. Each connection runs the script once, one after the other.
#pragma once

#include <atomic>
#include <functional>
#include <optional>
#include <string>
#include <thread>

#include "core/base/unique_fd.hpp"
#include "core/wire/frame.hpp"
#include "network.pb.h"

namespace dssm::test {

// One connection, in the fake's thread. When the client or the test ends, take() gives nothing.
class FakePeer {
 public:
  explicit FakePeer(int socket) : socket_(socket) {}

  std::optional<net::Frame> take();
  void send(const net::Frame& frame);
  void send_bytes(const std::string& bytes);

  // Takes the client's Hello and answers with one.
  void greet();
  // The same, then takes Open or Create and answers with a stream of such samples. Gives the
  // request.
  net::Frame open(std::uint64_t payload_bytes, std::uint64_t incarnation = 1,
                  const std::string& type_name = "");
  // Takes Subscribe and says that `first` comes first. Gives the request.
  net::Frame subscribe(std::int64_t first, std::uint64_t incarnation = 1);
  void send_sample(std::int64_t tid, const std::string& payload, std::uint64_t serial = 0,
                   bool torn = false);
  // Serves nothing until the other side closes.
  void wait_for_end();

 private:
  int socket_;
  wire::FrameBuffer input_{65U << 20};
};

class FakeDaemon {
 public:
  // Called with each connection and its number, from 0.
  explicit FakeDaemon(std::function<void(FakePeer&, int)> script);
  FakeDaemon(const FakeDaemon&) = delete;
  FakeDaemon& operator=(const FakeDaemon&) = delete;
  ~FakeDaemon();

  const std::string& address() const { return address_; }
  // How many connections the script has ended.
  int ended() const { return ended_; }
  // Hangs up on whoever is connected.
  void hang_up();

 private:
  void serve(const std::function<void(FakePeer&, int)>& script);

  UniqueFd listener_;
  std::string address_;
  std::atomic<int> connected_{-1};
  std::atomic<int> ended_{0};
  std::atomic<bool> stop_{false};
  std::thread thread_;
};

}  // namespace dssm::test
