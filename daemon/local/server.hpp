// SPDX-License-Identifier: Apache-2.0
//
// Accepts the programs of this PC and keeps their connections.
#pragma once

#include <cstdint>
#include <map>
#include <memory>
#include <vector>

#include "core/base/unique_fd.hpp"
#include "daemon/base/event_loop.hpp"
#include "daemon/base/log.hpp"
#include "daemon/base/spare_descriptor.hpp"
#include "daemon/local/connection.hpp"
#include "daemon/local/listener.hpp"
#include "daemon/local/local_service.hpp"

namespace dssm::daemon {

class Server {
 public:
  // Serves from the construction on; everything given outlives it.
  Server(const EventLoop& loop, const Listener& listener, std::uint64_t max_clients,
         LocalService& service, Logger& logger);
  Server(const Server&) = delete;
  Server& operator=(const Server&) = delete;

  void set_max_clients(std::uint64_t max_clients) { max_clients_ = max_clients; }  // for who comes

 private:
  void on_connection();
  void accept(UniqueFd socket);
  void turn_away(UniqueFd socket, const Error& error);

  const EventLoop& loop_;
  const Listener& listener_;
  std::uint64_t max_clients_;
  LocalService& service_;
  Logger& logger_;
  SpareDescriptor spare_;
  std::uint64_t next_ = 0;
  std::map<std::uint64_t, std::unique_ptr<Connection>> connections_;
  std::vector<std::uint64_t> ended_;  // to be destroyed outside of their own callbacks
  EventSource incoming_, sweep_;
};

}  // namespace dssm::daemon
