// SPDX-License-Identifier: Apache-2.0
//
// Accepts the programs of this PC, within max_clients, and owns their connections.
#pragma once

#include <cstdint>
#include <dssm/result.hpp>
#include <map>
#include <memory>
#include <string>
#include <vector>

#include "core/base/unique_fd.hpp"
#include "daemon/base/acceptor.hpp"
#include "daemon/base/event_loop.hpp"
#include "daemon/base/log.hpp"
#include "daemon/local/connection.hpp"
#include "daemon/local/listener.hpp"
#include "daemon/local/local_service.hpp"

namespace dssm::daemon {

class Server {
 public:
  // Serves from the construction on; everything given by reference outlives it.
  Server(const EventLoop& loop, const Listener& listener, const std::string& host,
         std::uint64_t max_clients, LocalService& service, Logger& logger);
  Server(const Server&) = delete;
  Server& operator=(const Server&) = delete;

  void set_max_clients(std::uint64_t max_clients) { max_clients_ = max_clients; }  // for new ones

 private:
  Result<void> accept(UniqueFd& socket);

  const EventLoop& loop_;
  std::uint64_t max_clients_;
  LocalService& service_;
  Logger& logger_;
  std::uint64_t next_ = 0;
  std::map<std::uint64_t, std::unique_ptr<Connection>> connections_;
  std::vector<std::uint64_t> ended_;  // to be destroyed outside of their own callbacks
  EventSource sweep_;
  Acceptor acceptor_;
};

}  // namespace dssm::daemon
