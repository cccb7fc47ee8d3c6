// SPDX-License-Identifier: Apache-2.0
//
// The watches of a Session: one Watch request at dssmd for all of them, and the list of streams
// that they know. After a reconnect dssmd sends the whole list again; the watches get the
// differences.
#pragma once

#include <dssm/session.hpp>
#include <functional>
#include <map>
#include <mutex>
#include <string>
#include <vector>

#include "client/src/daemon_connection.hpp"

namespace dssm::detail {

// Thread-safe.
class StreamWatches {
 public:
  using OnEvent = std::function<void(const StreamEvent&)>;

  explicit StreamWatches(DaemonConnection& connection) : connection_(connection) {}

  Result<std::uint64_t> add(OnEvent on_event);
  void remove(std::uint64_t key);  // waits for a running callback
  // The streams that exist; none without a watch.
  std::vector<StreamId> known_ids();

  // --- for the thread that reads the connection

  // A new connection is in use.
  void on_connected();
  void on_message(const local::Response& message);

 private:
  void on_event(const proto::StreamEvent& message);
  void on_list_complete();

  DaemonConnection& connection_;
  std::uint64_t repeated_watch_ = 0;  // serial of the Watch sent by on_connected()

  std::mutex mutex_;  // guards what follows; held while callbacks run
  bool watching_ = false;
  std::uint64_t next_key_ = 1;
  std::map<std::uint64_t, OnEvent> watches_;
  std::map<std::string, StreamInfo> known_;        // by full name, as the watches know them
  std::map<std::string, StreamInfo> unconfirmed_;  // of them, not sent since the reconnect
};

}  // namespace dssm::detail
