// SPDX-License-Identifier: Apache-2.0
//
// The Unix socket that programs of this PC connect to, and their connections. LocalService serves
// the requests.
//
//   Listener    the socket
//   Connection  one program: cuts its bytes into frames, and sends the responses
//   Server      accepts programs, and owns their connections
#pragma once

#include <sys/types.h>

#include <cstddef>
#include <cstdint>
#include <deque>
#include <dssm/result.hpp>
#include <functional>
#include <map>
#include <memory>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "core/base/unique_fd.hpp"
#include "core/wire/frame.hpp"
#include "daemon/base/acceptor.hpp"
#include "daemon/base/descriptor_closer.hpp"
#include "daemon/base/event_loop.hpp"
#include "daemon/base/limit_use.hpp"
#include "daemon/base/log.hpp"
#include "daemon/base/memory_budget.hpp"
#include "daemon/base/turn_queue.hpp"
#include "daemon/local/local_service.hpp"

namespace dssm::daemon {

// The listening socket. Its owner also holds the lock on the folder (RuntimeDir), so an existing
// socket file is that of a dssmd that was killed, or of one that had streams and left the file for
// its successor, or of a socket that the service manager passed. The latter is used as it is and
// not removed: programs that connect while no dssmd runs wait there.
class Listener {
 public:
  // Listens at `path` with that group (none: keep it) and mode; no program can connect before both
  // are set. inherited: the socket that the service manager passed for `path`; none: makes one.
  static Result<Listener> open(const std::string& path, std::optional<gid_t> group, mode_t mode,
                               UniqueFd inherited = {});

  Listener(Listener&&) = default;
  Listener& operator=(Listener&&) = delete;
  ~Listener();  // removes the socket file, unless it was inherited or leave_file() was called

  int fd() const noexcept { return fd_.get(); }

  // Programs may hold streams of this dssmd when it has ended: its successor finds the file.
  void leave_file() noexcept { leaves_file_ = true; }
  // A socket file was there: programs may hold streams of the dssmd before this one.
  bool found_file() const noexcept { return found_file_; }

  // The service manager passed it. Then it is unknown whether a dssmd ran before.
  bool inherited() const noexcept { return inherited_; }

 private:
  Listener(std::string path, UniqueFd fd) : path_(std::move(path)), fd_(std::move(fd)) {}
  Result<void> allow(std::optional<gid_t> group, mode_t mode) const;
  std::string path_;
  UniqueFd fd_;
  bool found_file_ = false, leaves_file_ = false;
  bool inherited_ = false;
};

// Bytes that wait for one client. A list of all streams has at most 16 MiB.
inline constexpr std::size_t kMaxQueuedBytes = 64U << 20;

// Bytes and descriptors that wait for one client, from which on its requests wait, too: who asks
// and never reads costs one answer.
inline constexpr std::size_t kPausingBytes = 64U << 10;
inline constexpr std::size_t kMaxQueuedDescriptors = 256;

// Descriptors that a client sent and that no request has taken yet; more are an error.
inline constexpr std::size_t kMaxUnclaimedDescriptors = 64;

// Connections that wait to be accepted; further programs wait in connect(). Few, so that programs
// that come and go keep no other one waiting for long.
inline constexpr int kBacklog = 128;

// Requests of one client served in a row before others get their turn: so many, or as many as are
// begun in that time.
inline constexpr int kRequestsPerTurn = 16;
inline constexpr Duration kMaxTurn = std::chrono::milliseconds(1);

// For the Hello of a program.
inline constexpr Duration kLocalHelloTimeout = std::chrono::seconds(10);

// For a client to read something of what waits for it; after at most twice as long it is
// disconnected. The library connects again, and gives its streams back.
inline constexpr Duration kLocalOutputTimeout = std::chrono::seconds(10);

// Memory for long messages of all clients, and of those of one user: requests that they have begun
// to send, and what waits for them to be received: a list of all streams.
inline constexpr std::size_t kMaxMessageBytes = 256U << 20;
inline constexpr std::size_t kMaxMessageBytesPerUser = kMaxMessageBytes / 2;
// For the rest of a long request: then its memory is free again.
inline constexpr Duration kLongRequestTimeout = std::chrono::seconds(10);

// What one user's programs take.
struct UserAccount {
  explicit UserAccount(uid_t user)
      : uid(user),
        is_limited(daemon::is_limited(user)),
        messages(is_limited ? kMaxMessageBytesPerUser : kMaxMessageBytes) {}
  const uid_t uid;
  const bool is_limited;
  std::uint64_t places() const { return clients + closer.unclosed(); }
  std::uint64_t clients = 0;
  MemoryBudget messages;  // memory for long ones
  // Of the sockets, and of what came by them. What it has not closed counts as clients, so that
  // nobody can have it hold ever more.
  DescriptorCloser closer;
};

// One client's socket: cuts its bytes into frames for LocalService and sends the responses. It
// never waits for the client. What the client does not receive is queued up to kMaxQueuedBytes,
// then the connection is closed; an error closes this connection only.
class Connection final : public ClientOutput {
 public:
  //   messages   memory for long ones, of all clients
  //   on_closed  called once, when the connection ended by itself; the connection must not be
  //              destroyed within it
  Connection(const EventLoop& loop, UniqueFd socket, const Identity& identity,
             LocalService& service, TurnQueue& turns, MemoryBudget& messages, UserAccount& user,
             Logger& logger, std::function<void()> on_closed);
  Connection(const Connection&) = delete;
  Connection& operator=(const Connection&) = delete;
  ~Connection();

  void send(std::string bytes, std::vector<UniqueFd> descriptors) override;
  void request_turn() override { turn_.wait(TurnQueue::Reason::event); }

 private:
  struct Outgoing {
    std::string bytes;
    std::size_t sent = 0;
    std::vector<UniqueFd> descriptors;
  };

  template <class Work>
  void guarded(Work work);
  void on_readable();
  void on_writable();
  void serve_frames();
  // Memory for long messages, of all clients and of the user.
  struct Share {
    MemoryShare of_all, of_user;
  };
  bool charge(std::size_t bytes, Share& share);
  bool charge_input();
  bool charge_output();
  Error no_memory_for(std::string_view what) const;
  bool take_descriptors(std::vector<UniqueFd> arrived);
  void close_socket();
  bool send_some(Outgoing& outgoing);
  void stop_output();
  void watch_output();
  void on_output_timeout();
  void end_with(const Error& error);
  void close(bool by_client = false);
  void leave();
  bool is_open() const noexcept { return static_cast<bool>(socket_); }
  bool is_paused() const noexcept {
    return queued_descriptors_ >= kMaxQueuedDescriptors || queued_bytes_ >= kPausingBytes;
  }

  UniqueFd socket_;
  LocalService& service_;
  Logger& logger_;
  std::function<void()> on_closed_;
  ClientNumber number_;
  wire::FrameBuffer input_;
  MemoryBudget& messages_;
  UserAccount& user_;
  Share input_share_, output_share_;
  std::vector<UniqueFd> unchecked_;  // descriptors whose close() may wait
  DescriptorQueue arrived_;
  std::deque<Outgoing> output_;
  std::size_t queued_bytes_ = 0, queued_descriptors_ = 0;
  std::uint64_t sent_bytes_ = 0;
  bool has_reader_ = true;  // the client may receive what is sent
  bool leaves_ = false;     // it is closed, and has opens that are still to be ended
  bool by_client_ = false;  // it was closed so
  // Bytes sent, and what of them the client has not read, when output was watched last.
  using Progress = std::pair<std::uint64_t, int>;
  Progress progress() const noexcept;
  std::optional<Progress> watched_;  // none: nothing waits
  TurnQueue& turns_;
  TurnQueue::Turn turn_;
  TurnQueue::Reason waits_for_{};  // what it gets when it goes on
  EventSource readable_, writable_, greeting_timeout_, request_timeout_, output_timer_;
};

// Accepts the programs of this PC, within the limits, and owns their connections.
class Server {
 public:
  struct Limits {
    std::uint64_t max_clients = 0;
    std::uint64_t max_clients_per_user = 0;
  };

  // Serves from the construction on; everything given by reference outlives it.
  Server(const EventLoop& loop, const Listener& listener, const std::string& host,
         const Limits& limits, LocalService& service, Logger& logger);
  Server(const Server&) = delete;
  Server& operator=(const Server&) = delete;

  void set_limits(const Limits& limits) { limits_ = limits; }  // for new ones
  void add_limits(LimitUses& out) const;

 private:
  Result<void> accept(UniqueFd& socket);
  void close_refused(UniqueFd socket);
  std::uint64_t unclosed() const;
  void keep(UniqueFd socket, const Identity& identity, UserAccount& user);
  void sweep();

  const EventLoop& loop_;
  Limits limits_;
  LocalService& service_;
  MemoryBudget messages_{kMaxMessageBytes};
  RateLimitedLogger logger_;  // how often programs come and are refused is decided by them
  TurnQueue turns_;
  std::uint64_t next_ = 0;
  std::map<uid_t, UserAccount> users_;  // before the connections, which hold shares of the budgets
  std::map<std::uint64_t, std::unique_ptr<Connection>> connections_;
  std::vector<std::uint64_t> ended_;  // to be destroyed outside of their own callbacks
  EventSource sweep_;
  Acceptor acceptor_;
};

}  // namespace dssm::daemon
