// SPDX-License-Identifier: Apache-2.0
//
// Accepts connections at listening sockets, of programs (Unix) and of other hosts (TCP). A
// connection that cannot be served gets a final failure with the reason. A spare descriptor is kept
// for the time when the process has none left: without it a waiting connection could not even be
// refused, and the loop would spin.
#pragma once

#include <chrono>
#include <dssm/result.hpp>
#include <dssm/time.hpp>
#include <functional>
#include <string>
#include <vector>

#include "core/base/unique_fd.hpp"
#include "daemon/base/event_loop.hpp"
#include "daemon/base/log.hpp"

namespace dssm::daemon {

class Acceptor {
 public:
  // Accepted in a row before existing connections get their turn.
  static constexpr int kConnectionsPerTurn = 16;
  // Until it is tried again whether one can be accepted.
  static constexpr Duration kPause = std::chrono::milliseconds(100);

  // Serves an accepted socket, which is non-blocking; moves from `socket` only if it succeeds. An
  // error refuses the connection.
  using Accept = std::function<Result<void>(UniqueFd& socket)>;

  // peer: for the log, "a program". host: this one. loop and logger outlive it.
  //   message_id  of the log line of a refusal
  Acceptor(const EventLoop& loop, Logger& logger, std::string peer, std::string host,
           std::string_view message_id, Accept accept);
  Acceptor(const Acceptor&) = delete;
  Acceptor& operator=(const Acceptor&) = delete;

  // What closes a refused socket; without it, the loop does.
  struct Closer {
    std::function<void(UniqueFd socket)> close;
    std::function<bool()> is_full;  // asked before each accept; while it is, nobody is accepted
  };
  void set_closer(Closer closer) { closer_ = std::move(closer); }

  // Accepts from now on at `listener`, which outlives this.
  void listen(int listener);

 private:
  void on_connection(int listener);
  void accept_to_refuse(int listener);
  void refuse(UniqueFd socket, const Error& error);
  void pause();

  const EventLoop& loop_;
  Logger& logger_;
  const std::string peer_, host_;
  const std::string_view message_id_;
  const Accept accept_;
  Closer closer_;
  UniqueFd spare_;
  std::vector<EventSource> listeners_;
  EventSource pause_;
};

}  // namespace dssm::daemon
