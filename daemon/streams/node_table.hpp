// SPDX-License-Identifier: Apache-2.0
//
// Processes and what each reads and writes, put together from several reports: a process may have
// several connections, and both its own host and the owner of a stream may report the same use.
#pragma once

#include <cstdint>
#include <dssm/stream.hpp>
#include <map>
#include <optional>
#include <set>
#include <string>
#include <tuple>
#include <vector>

#include "catalog.pb.h"

namespace dssm::daemon {

// A value.
class NodeTable {
 public:
  // own_host: comes first in the list.
  explicit NodeTable(std::string own_host) : own_host_(std::move(own_host)) {}

  // `user`, with its host, has `stream` open, which is given with its host. Processes without a pid
  // that have one name are one.
  void add(const StreamUser& user, const StreamId& stream);
  // Nothing is known of the processes of `host`.
  void add_unknown(const std::string& host, const std::string& error) { errors_[host] = error; }

  // By host, program and pid; each process's streams by name, readers first.
  void to_message(proto::NodeList& out) const;

 private:
  // Host, program, pid.
  using Key = std::tuple<std::string, std::string, std::int32_t>;
  struct Node {
    std::optional<std::uint32_t> uid;
    // Name, id, host, whether it writes, via.
    std::set<std::tuple<std::string, std::int32_t, std::string, bool, StreamVia>> streams;
  };
  void add_host(const std::string& host, proto::NodeList& out) const;

  std::string own_host_;
  std::map<Key, Node> nodes_;
  std::map<std::string, std::string> errors_;  // by host
};

}  // namespace dssm::daemon
