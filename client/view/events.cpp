// SPDX-License-Identifier: Apache-2.0
#include "client/view/events.hpp"

#include <fmt/format.h>

#include <utility>

#include "client/dssmctl/black_box_streams.hpp"
#include "client/dssmctl/describe.hpp"

namespace dssm::view {

void Events::add(bool is_warning, std::string text) {
  events_.push_back({{"number", ++last_event_},
                     {"time_ns", time_json(WallClock::now())},
                     {"severity", is_warning ? "warn" : "info"},
                     {"text", std::move(text)}});
  if (events_.size() > kMaxEvents) events_.pop_front();
}

void Events::find(const std::vector<HostInfo>& hosts, const std::vector<StreamInfo>& streams) {
  const bool is_first = !std::exchange(has_state_, true);
  find_of_hosts(hosts, is_first);
  find_of_streams(streams, is_first);
}

void Events::find_of_hosts(const std::vector<HostInfo>& hosts, bool is_first) {
  std::map<std::string, std::pair<HostState, bool>> new_hosts;
  for (const HostInfo& host : hosts) {
    if (host.name.empty() || host.reason == HostReason::spare_address) continue;
    new_hosts[host.name] = {host.state, host.clock_refused};
    if (is_first) continue;
    const auto known = hosts_.find(host.name);
    const bool was_up = known != hosts_.end() && ctl::is_up(known->second.first);
    if (ctl::is_up(host.state) != was_up) {
      add(was_up, was_up ? fmt::format("host {} is down: {}", host.name,
                                       host.error.empty() ? "no answer" : host.error)
                         : fmt::format("host {} is up", host.name));
    }
    const bool was_refused = known != hosts_.end() && known->second.second;
    if (host.clock_refused != was_refused && ctl::is_up(host.state)) {
      add(host.clock_refused,
          host.clock_refused
              ? fmt::format("the clock of {} is out of bounds: {}", host.name, host.clock_reason)
              : fmt::format("the clock of {} is within its bounds again", host.name));
    }
  }
  for (const auto& [name, state] : hosts_) {
    if (ctl::is_up(state.first) && !new_hosts.contains(name)) {
      add(true, fmt::format("host {} is down: it is not known any more", name));
    }
  }
  hosts_ = std::move(new_hosts);
}

void Events::find_of_streams(const std::vector<StreamInfo>& streams, bool is_first) {
  std::map<std::string, Known> new_streams;
  for (const StreamInfo& stream : streams) {
    if (ctl::is_of_black_box(stream.id)) continue;
    const std::string name = stream.id.str();
    const auto known = streams_.find(name);
    // Of a host that does not answer just now, nothing is known; then the last state counts.
    const bool is_unknown = stream.state == StreamState::unknown && known != streams_.end();
    new_streams[name] = {is_unknown ? known->second.state : stream.state, false};
    if (is_first) continue;
    if (known == streams_.end()) {
      add(false, fmt::format("stream {} was created", name));
      continue;
    }
    const StreamState before = known->second.state;
    if (ctl::is_silent(stream) && before == StreamState::live) {
      add(true, fmt::format("stream {}: {}", name, name_of(stream.state)));
    } else if (stream.state == StreamState::live &&
               (before == StreamState::stalled || before == StreamState::no_writer)) {
      add(false, fmt::format("stream {} is live again", name));
    }
  }
  for (const auto& [name, known] : streams_) {
    if (new_streams.contains(name)) continue;
    // The streams of a host that is down are not listed, but may be there still; those of a host
    // that has just come are listed a little later.
    const auto host = hosts_.find(StreamId::parse(name)->host);
    const bool is_up = host != hosts_.end() && ctl::is_up(host->second.first);
    if (is_up && known.is_missing) {
      add(false, fmt::format("stream {} is gone", name));
    } else {
      new_streams[name] = {known.state, is_up};
    }
  }
  streams_ = std::move(new_streams);
}

}  // namespace dssm::view
