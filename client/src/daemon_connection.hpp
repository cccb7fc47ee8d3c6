// SPDX-License-Identifier: Apache-2.0
//
// The connection of a Session to its PC's dssmd: requests, and the threads that wait for their
// answers. It does not connect by itself: Client does, in a thread of its own, which also reads
// what arrives here.
//
//   greet()   NewConnection: one thread sends requests and reads answers in turn
//   use()     from now on all threads call() and post(); one thread read()s
//   drop()    the connection has ended: pending calls wait for the next one and send again
//
// All requests may therefore be repeated without harm.
#pragma once

#include <condition_variable>
#include <dssm/session.hpp>
#include <functional>
#include <map>
#include <mutex>
#include <optional>
#include <span>
#include <string>
#include <vector>

#include "core/base/unique_fd.hpp"
#include "core/wire/frame.hpp"
#include "core/wire/local_protocol.hpp"

namespace dssm::detail {

// Bytes and descriptors that arrived and are not processed yet.
struct LocalInput {
  wire::FrameBuffer frames{wire::kMaxLocalFrameBytes};
  std::vector<UniqueFd> fds;
};

// A connection that is being set up; only one thread uses it.
class NewConnection {
 public:
  // Connects and greets. `number` counts the connections of this process.
  //   fails  no_daemon, no_permission, protocol, unavailable
  static Result<NewConnection> greet(const SessionOptions& options, std::uint64_t number);

  // Sends one request and returns its answer, whose descriptors are then in fds(). A Failure is
  // returned as its error.
  Result<local::Response> exchange(local::Request request, std::span<const int> request_fds = {});

  std::vector<UniqueFd>& fds() noexcept { return input_.fds; }
  std::uint64_t number() const noexcept { return number_; }
  // Handles whose Replaced arrived between the answers.
  const std::vector<std::uint64_t>& replaced() const noexcept { return replaced_; }

 private:
  friend class DaemonConnection;
  NewConnection(UniqueFd socket, std::uint64_t number)
      : socket_(std::move(socket)), number_(number) {}

  UniqueFd socket_;
  std::uint64_t number_;
  LocalInput input_;
  std::vector<std::uint64_t> replaced_;
  std::uint64_t serial_ = 0;
};

struct Answer {
  local::Response response;
  std::vector<UniqueFd> fds;
  std::uint64_t connection = 0;  // number of the connection that it arrived on
};

// Thread-safe, except read().
class DaemonConnection {
 public:
  DaemonConnection(std::string socket_path, Duration request_timeout)
      : socket_path_(std::move(socket_path)), request_timeout_(request_timeout) {}

  // Takes over a connection that is set up.
  void use(NewConnection connection);
  // The connection has ended.
  void drop();
  bool is_up() const;

  // Sends the request and waits for its answer, across reconnects, for at most request_timeout. A
  // Failure is returned as its error. The caller keeps `fds`.
  Result<Answer> call(local::Request request, std::span<const int> fds = {});

  // Sends a request whose answer no call waits for, if the connection is up and has this number (0:
  // any).
  //   returns  its serial; 0: not sent
  std::uint64_t post(local::Request request, std::uint64_t number = 0);

  // Reads until the connection ends (an error) or `stop_fd` is readable (success). Messages that no
  // call waits for go to `on_message`: events, and answers to post(). `on_wake` is called when
  // `wake_fd` is readable. One thread.
  Result<void> read(int stop_fd, const std::function<void(const local::Response&)>& on_message,
                    int wake_fd, const std::function<void()>& on_wake);

 private:
  // A thread that waits for an answer.
  struct Waiter {
    std::optional<Answer> answer;
    bool dropped = false;  // the connection ended before the answer arrived
  };
  struct InFlight {
    Waiter* waiter = nullptr;  // nullptr: the call has timed out
    std::size_t fds = 0;       // descriptors that belong to a successful answer
  };

  Result<void> send_locked(const local::Request& request, std::span<const int> fds);
  // The descriptors in input_ that belong to this answer.
  Result<std::vector<UniqueFd>> take_fds(std::size_t count);
  Result<bool> deliver(local::Response& response);  // false: no call waits for it

  const std::string socket_path_;
  const Duration request_timeout_;
  LocalInput input_;  // of the thread that reads

  mutable std::mutex mutex_;         // guards all that follows
  std::condition_variable changed_;  // an answer arrived, or the connection began or ended
  UniqueFd socket_;
  std::uint64_t number_ = 0;
  std::uint64_t next_serial_ = 1;
  std::map<std::uint64_t, InFlight> in_flight_;
};

}  // namespace dssm::detail
