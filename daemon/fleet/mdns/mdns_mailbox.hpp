// SPDX-License-Identifier: Apache-2.0
//
// Between dssmd's loop and the thread that talks to Avahi. Both own it, so that either may outlive
// the other. It holds the newest word of each side, not a queue: neither can be flooded.
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
  // What the thread has to say since it was last asked.
  struct News {
    std::optional<FoundHosts> hosts;  // all of them
    std::optional<MdnsInfo> state;
    std::vector<std::pair<LogLevel, std::string>> lines;
  };

  static Result<std::shared_ptr<MdnsMailbox>> open();

  // dssmd's side.
  void want(std::vector<ServiceRecord> records);
  void stop();
  int news_fd() const noexcept { return news_.get(); }  // readable: there are news
  News take_news();
  bool wait_until_done(Duration patience) const;

  // The thread's side.
  int orders_fd() const noexcept { return orders_.get(); }
  std::optional<std::vector<ServiceRecord>> take_wanted();  // when it has changed
  bool stopping() const noexcept { return stopping_.load(); }
  void tell(FoundHosts hosts, MdnsInfo state);
  void log(LogLevel level, std::string text);
  void done();  // the thread's last word

 private:
  MdnsMailbox() = default;

  UniqueFd orders_, news_, done_;       // eventfds
  std::atomic<bool> stopping_ = false;  // set before the bell is rung, looked at after it is read
  std::mutex mutex_;                    // for all below
  std::optional<std::vector<ServiceRecord>> wanted_;
  News untold_;
};

}  // namespace dssm::daemon
