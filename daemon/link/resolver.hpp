// SPDX-License-Identifier: Apache-2.0
//
// Looks names up without keeping the loop waiting. getaddrinfo() takes as long as it likes and
// cannot be called off, so it has a thread of its own, which is asked one name at a time; those who
// wait for the same name share one answer.
#pragma once

#include <functional>
#include <memory>
#include <vector>

#include "core/wire/address.hpp"
#include "daemon/base/event_loop.hpp"

namespace dssm::daemon {

// One per dssmd. Destroyed, it forgets what was asked; its thread ends after the answer it is
// waiting for, or with the process.
class Resolver {
 public:
  // How names become addresses; tests bring a function of their own. Called in the thread.
  using Lookup = std::function<Result<std::vector<wire::SocketAddress>>(const wire::Address&)>;

  explicit Resolver(const EventLoop& loop, Lookup lookup = wire::resolve);
  Resolver(const Resolver&) = delete;
  Resolver& operator=(const Resolver&) = delete;
  ~Resolver();

  using Then = std::function<void(Result<std::vector<wire::SocketAddress>>)>;
  // Calls `then` from the loop, later; not after the returned ticket is gone. Numbers need no
  // thread. An answer has at least one address.
  using Ticket = std::shared_ptr<void>;
  Ticket resolve(const wire::Address& address, Then then);

 private:
  struct Question;
  struct Shared;
  static void work(const std::shared_ptr<Shared>& shared);
  void deliver();

  std::shared_ptr<Shared> shared_;  // with the thread
  bool started_ = false;
  EventSource answered_;
};

}  // namespace dssm::daemon
