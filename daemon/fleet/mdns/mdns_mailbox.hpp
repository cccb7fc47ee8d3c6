// SPDX-License-Identifier: Apache-2.0
//
// Between dssmd's loop and the thread that talks to Avahi. Both own it, so that either may outlive
// the other. It holds the newest state of each side, not a queue: neither can be flooded.
#pragma once

#include <atomic>
#include <map>
#include <memory>
#include <mutex>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "core/base/unique_fd.hpp"
#include "daemon/base/log.hpp"
#include "daemon/fleet/found_host.hpp"
#include "daemon/fleet/service_record.hpp"

namespace dssm::daemon {

using FoundHosts = std::map<wire::HostId, FoundHost>;

class MdnsMailbox {
 public:
  // What the thread has reported since the last call of take_update().
  struct Update {
    std::optional<FoundHosts> hosts;  // all of them
    std::optional<MdnsInfo> state;
    std::vector<std::pair<LogLevel, std::string>> lines;
  };

  static Result<std::shared_ptr<MdnsMailbox>> open();

  // dssmd's side.
  void want(std::vector<ServiceRecord> records);
  void stop();
  int updates_fd() const noexcept { return updates_.get(); }  // readable: there is an update
  Update take_update();
  bool wait_until_done(Duration timeout) const;

  // The thread's side.
  int orders_fd() const noexcept { return orders_.get(); }
  std::optional<std::vector<ServiceRecord>> take_wanted();  // when it has changed
  bool stopping() const noexcept { return stopping_.load(); }
  void report(FoundHosts hosts, MdnsInfo state);
  void log(LogLevel level, std::string text);
  void done();  // the thread is about to end

 private:
  MdnsMailbox() = default;

  UniqueFd orders_, updates_, done_;    // eventfds
  std::atomic<bool> stopping_ = false;  // set before the bell is rung, checked after it is read
  std::mutex mutex_;                    // for all below
  std::optional<std::vector<ServiceRecord>> wanted_;
  Update pending_;
};

}  // namespace dssm::daemon
