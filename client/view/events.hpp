// SPDX-License-Identifier: Apache-2.0
//
// What has happened on the vehicle since dssm-view was started, from how the lists of hosts and
// streams differ from one second to the next.
#pragma once

#include <cstdint>
#include <deque>
#include <dssm/session.hpp>
#include <map>
#include <string>
#include <utility>
#include <vector>

#include "client/dssmctl/output.hpp"

namespace dssm::view {

// JavaScript's numbers are too coarse for nanoseconds since 1970, so times are texts.
inline ctl::Json time_json(Time time) { return std::to_string(to_ns(time)); }

class Events {
 public:
  // Adds what differs from the last call. The first one adds nothing.
  void find(const std::vector<HostInfo>& hosts, const std::vector<StreamInfo>& streams);
  void add(bool is_warning, std::string text);

  // The newest ones, oldest first, as "overview" of the page's protocol has them (docs/view.md).
  const std::deque<ctl::Json>& all() const { return events_; }

 private:
  static constexpr std::size_t kMaxEvents = 200;

  struct Known {
    StreamState state = StreamState::unknown;
    bool is_missing = false;  // it was not listed at the last call, although its host was up
  };

  void find_of_hosts(const std::vector<HostInfo>& hosts, bool is_first);
  void find_of_streams(const std::vector<StreamInfo>& streams, bool is_first);

  bool has_state_ = false;
  std::map<std::string, std::pair<HostState, bool>> hosts_;  // and whether its clock is refused
  std::map<std::string, Known> streams_;
  std::deque<ctl::Json> events_;
  std::uint64_t last_event_ = 0;
};

}  // namespace dssm::view
