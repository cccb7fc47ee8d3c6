// SPDX-License-Identifier: Apache-2.0
//
// A program that speaks the local protocol by hand: the tests of dssmd use no client library, so
// that they can do what none would. Blocking; a dssmd that does not answer ends the test after
// kTimeoutSeconds.
#pragma once

#include <dssm/stream.hpp>
#include <span>
#include <string>
#include <thread>
#include <utility>
#include <vector>

#include "core/base/unique_fd.hpp"
#include "core/wire/frame.hpp"
#include "core/wire/local_protocol.hpp"
#include "tests/support/await.hpp"
#include "tests/support/daemon_process.hpp"

namespace dssm::test {

inline constexpr int kTimeoutSeconds = 60;

struct Answer {
  local::Response response;
  std::vector<UniqueFd> descriptors;
  bool ended = false;  // the connection ended instead
};

class RawClient {
 public:
  // Connects; without `greet` it does not say Hello.
  explicit RawClient(const std::string& socket_path, bool greet = true,
                     const std::string& program = "raw");

  // One request under a new serial, and its answer; events that come before it are dropped.
  Answer ask(local::Request request, std::span<const int> descriptors = {});

  std::uint64_t send(local::Request request, std::span<const int> descriptors = {});
  void send_bytes(std::string_view bytes, std::span<const int> descriptors = {});
  Answer receive();  // the next response of any kind

  // Whether an answer is there, without waiting for one.
  bool has_answer();

  int fd() const { return socket_.get(); }
  void close() { socket_.reset(); }

 private:
  UniqueFd socket_;
  wire::FrameBuffer input_{wire::kMaxLocalFrameBytes};
  std::vector<UniqueFd> descriptors_;
  std::uint64_t serial_ = 0;
};

local::Request create_request(const std::string& name, std::uint64_t depth = 16);
local::Request open_request(const std::string& name, bool for_writing = false);
local::Request offer_request(const std::string& name, bool for_writing = false);
local::Request list_request();
local::Request list_opens_request();
local::Request list_clients_request();

std::string numbered(std::string name, std::size_t number);  // "stream7"

// The numbers of descriptors, e.g. to send them.
std::vector<int> numbers(const std::vector<UniqueFd>& descriptors);

// How many descriptors process `pid` has open.
int open_descriptors(pid_t pid);
// The same for a dssmd that has nothing to do: without the socket that it opens for a moment to ask
// chronyd, in which a busy machine may interrupt it.
int idle_descriptors(pid_t pid);

// Asks again and again until `done` is true; for what happens soon, but not as an answer. Returns
// false when it did not happen in kTimeoutSeconds.
template <class Done>
bool eventually(Done done) {
  const MonoTime deadline = deadline_in(std::chrono::seconds(kTimeoutSeconds));
  while (!done()) {
    if (MonoClock::now() > deadline) return false;
    std::this_thread::sleep_for(kPollPause);
  }
  return true;
}

}  // namespace dssm::test
