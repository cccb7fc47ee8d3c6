// SPDX-License-Identifier: Apache-2.0
//
// One client's socket: cuts its bytes into frames for LocalService and sends the responses. It
// never waits for the client. What the client does not receive is queued up to kMaxQueuedBytes,
// then the connection is closed; an error closes this connection only.
#pragma once

#include <cstddef>
#include <cstdint>
#include <deque>
#include <functional>
#include <string>
#include <vector>

#include "core/base/unique_fd.hpp"
#include "core/wire/frame.hpp"
#include "daemon/base/event_loop.hpp"
#include "daemon/base/log.hpp"
#include "daemon/local/local_service.hpp"

namespace dssm::daemon {

// Bytes that wait for one client. A list of all streams has at most 16 MiB.
inline constexpr std::size_t kMaxQueuedBytes = 64U << 20;

// Descriptors that wait for one client; from this number on its requests wait, too.
inline constexpr std::size_t kMaxQueuedDescriptors = 256;

// Descriptors that a client sent and that no request has taken yet; more are an error.
inline constexpr std::size_t kMaxUnclaimedDescriptors = 64;

// Requests of one client served in a row before others get their turn.
inline constexpr int kRequestsPerTurn = 16;

class Connection final : public ClientOutput {
 public:
  // on_closed: called once, when the connection ended by itself; the connection must not be
  // destroyed within it.
  Connection(const EventLoop& loop, UniqueFd socket, const Identity& identity,
             LocalService& service, Logger& logger, std::function<void()> on_closed);
  Connection(const Connection&) = delete;
  Connection& operator=(const Connection&) = delete;
  ~Connection();

  void send(const std::string& frame, std::vector<UniqueFd> descriptors) override;

 private:
  struct Outgoing {
    std::string frame;
    std::size_t sent = 0;
    std::vector<UniqueFd> descriptors;
  };

  void on_readable();
  void on_writable();
  void serve_frames();
  bool take_descriptors(std::vector<UniqueFd> arrived);
  bool send_some(Outgoing& outgoing);
  void end_with(const Error& error);
  void close();
  bool is_open() const noexcept { return static_cast<bool>(socket_); }
  bool is_paused() const noexcept { return queued_descriptors_ >= kMaxQueuedDescriptors; }

  UniqueFd socket_;
  LocalService& service_;
  Logger& logger_;
  std::function<void()> on_closed_;
  ClientNumber number_;
  wire::FrameBuffer input_;
  DescriptorQueue arrived_;
  std::deque<Outgoing> output_;
  std::size_t queued_bytes_ = 0, queued_descriptors_ = 0;
  EventSource readable_, writable_, next_turn_;
};

}  // namespace dssm::daemon
