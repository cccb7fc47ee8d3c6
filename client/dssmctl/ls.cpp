// SPDX-License-Identifier: Apache-2.0
//
// dssmctl ls: all streams of all hosts, own ones first, each host's in the order of their creation
// without --sort. One request to dssmd (two for names or hosts), one write; it is run in
// loops and by the shell's completion, so it has to be quick.
//
// With --watch: what is there, then a line for each stream that is added or removed, until Ctrl-C.
// dssmd sends events, nothing is polled. While dssmd is unavailable there are none; when it is
// available again, only what has changed meanwhile is shown.
#include <fmt/format.h>

#include <algorithm>
#include <condition_variable>
#include <mutex>
#include <set>

#include "client/dssmctl/describe.hpp"
#include "client/dssmctl/names.hpp"
#include "client/dssmctl/open_stream.hpp"
#include "client/dssmctl/options.hpp"
#include "client/dssmctl/output.hpp"
#include "client/dssmctl/stream_list.hpp"
#include "client/dssmctl/text.hpp"
#include "core/base/try.hpp"

namespace dssm::ctl {
namespace {

// A document as json_document() writes it, but without a tree of a thousand streams in memory.
void print_json(const StreamListing& listing, Output& out) {
  if (listing.streams.empty()) return out.add(json_document({{"streams", Json::array()}}));
  out.add("{\n  \"streams\": [\n");
  std::string_view separator;
  for (const StreamInfo& stream : listing.streams) {
    out.add(separator);
    std::string text = json_document(listed_stream_json(listing, stream));
    text.pop_back();  // its line end
    // Strings in JSON have no line ends.
    for (std::size_t at = 0; at != text.npos; at = text.find('\n', at + 1)) {
      text.insert(at == 0 ? 0 : at + 1, "    ");
    }
    out.add(text);
    separator = ",\n";
  }
  out.add("\n  ]\n}\n");
}

void print_table(const StreamListing& listing, Output& out) {
  stream_table(listing, out.columns()).print(out);
  const auto marked =
      std::find_if(listing.streams.rbegin(), listing.streams.rend(),
                   [&](const StreamInfo& stream) { return listing.duplicate(stream); });
  if (marked != listing.streams.rend()) {
    out.add(
        fmt::format("* several hosts have a stream of this name and id: say which one, as in {}\n",
                    escaped(marked->id.str())));
  }
}

// A program must get a name as it is; a terminal must not.
Result<void> print_names(Session& session, const std::vector<StreamInfo>& all,
                         const StreamFilter& filter, Output& out) {
  const DaemonInfo daemon = DSSM_TRY(session.daemon_info());
  const std::vector<std::string> names = opening_names(all, daemon.host);
  for (std::size_t i = 0; i < all.size(); ++i) {
    if (!filter.takes(all[i].id)) continue;
    out.add((out.terminal() ? escaped(names[i]) : names[i]) + "\n");
  }
  return {};
}

// A name that no host has would show nothing forever.
Result<void> check_hosts(Session& session, const std::vector<std::string>& wanted) {
  if (wanted.empty()) return {};
  const std::vector<HostInfo> hosts = DSSM_TRY(session.list_hosts());
  std::set<std::string> known;
  for (const HostInfo& host : hosts) {
    if (!host.name.empty()) known.insert(host.name);
  }
  for (const std::string& name : wanted) {
    if (known.contains(name)) continue;
    return Error{Errc::not_found,
                 fmt::format("list the streams of host '{}': no such host is known here; known are "
                             "'{}'; see `dssmctl hosts`",
                             name, fmt::join(known, "', '"))};
  }
  return {};
}

// Hosts that could have streams: those that are known and not reached.
std::vector<std::string> missing_hosts(Session& session) {
  std::vector<std::string> names;
  const Result<std::vector<HostInfo>> hosts = session.list_hosts();
  if (!hosts) return names;
  for (const HostInfo& host : *hosts) {
    const bool is_missing = host.state == HostState::connecting || host.state == HostState::down ||
                            host.state == HostState::refused;
    if (!is_missing || host.reason == HostReason::spare_address) continue;
    names.push_back(host.name.empty() ? host.addresses.front() : host.name);
  }
  return names;
}

// For standard error, so that standard output stays a table.
std::string why_empty(Session& session, const LsOptions& options, std::size_t all) {
  if (all == 0) {
    if (options.own) return "this PC owns no streams";
    const std::vector<std::string> missing = missing_hosts(session);
    if (missing.empty()) return "no streams; programs create them, or 'dssmctl create'";
    return fmt::format("no streams; not reached: {}; see `dssmctl hosts`", list_text(missing, 5));
  }
  const std::string others =
      fmt::format("there {} {} other{}", all == 1 ? "is" : "are", all, all == 1 ? "" : "s");
  if (options.pattern.empty()) return "no streams of these hosts; " + others;
  return fmt::format("no streams that fit '{}'; {}", escaped(options.pattern), others);
}

// --- ls --watch

// Events of the session's thread that this program has not shown yet. It grows only while our
// output is not read, by the streams that are added and removed meanwhile.
class EventQueue {
 public:
  void put(const StreamEvent& event) {
    const std::lock_guard lock(mutex_);
    events_.push_back(event);
    came_.notify_one();
  }

  // All that came; waits for the first one, but not for longer than kStopCheckPeriod.
  std::vector<StreamEvent> take() {
    std::unique_lock lock(mutex_);
    came_.wait_for(lock, kStopCheckPeriod, [this] { return !events_.empty(); });
    return std::exchange(events_, {});
  }

 private:
  std::mutex mutex_;
  std::condition_variable came_;
  std::vector<StreamEvent> events_;
};

// What does not change while the stream exists: an event has nothing else, or as it was long ago.
StreamInfo identity_of(StreamInfo stream) {
  stream.oldest = stream.newest = kNoTid;
  stream.rate_hz = 0;
  stream.state = StreamState::unknown;
  return stream;
}

// Prints a line for each stream that comes or goes.
class StreamLog {
 public:
  StreamLog(const LsOptions& options, const StreamFilter& filter, Output& out)
      : json_(options.json), filter_(filter), out_(out) {}

  void on_event(const StreamEvent& event) {
    if (!filter_.takes(event.stream.id) || event.property_set || event.described) return;
    const std::string name = event.stream.id.str();
    if (event.kind == StreamEvent::Kind::removed) {
      shown_.erase(name);
      return print_removed(event.stream.id);
    }
    // A stream that was recreated while dssmd was unavailable is reported as added only.
    if (!shown_.insert(name).second) print_removed(event.stream.id);
    print_added(event.stream);
  }

 private:
  void print_added(const StreamInfo& stream) {
    if (json_) {
      Json json = {{"event", "added"}};
      json.update(stream_json(identity_of(stream)));
      return out_.add(json_line(json));
    }
    out_.add(fmt::format("+ {} {} bytes, depth {}, cycle {}{}{}\n", escaped(stream.id.str()),
                         stream.type.payload_bytes, stream.depth, duration_text(stream.cycle),
                         stream.type.name.empty() ? "" : ", ", escaped(stream.type.name)));
  }

  void print_removed(const StreamId& id) {
    if (!json_) return out_.add(fmt::format("- {}\n", escaped(id.str())));
    out_.add(json_line({{"event", "removed"},
                        {"stream", id.str()},
                        {"name", id.name},
                        {"id", id.id},
                        {"host", id.host}}));
  }

  bool json_;
  const StreamFilter& filter_;
  Output& out_;
  std::set<std::string> shown_;  // full names
};

Result<void> watch_streams(Session& session, const LsOptions& options, const StreamFilter& filter,
                           Output& out) {
  catch_stop_signals();
  const auto queue = std::make_shared<EventQueue>();
  const Session::Watch watch =
      DSSM_TRY(session.watch([queue](const StreamEvent& event) { queue->put(event); }));
  StreamLog log(options, filter, out);
  do {
    for (const StreamEvent& event : queue->take()) log.on_event(event);
  } while (out.flush() && !out.must_stop());
  return {};
}

// --- both

std::vector<std::string> patterns_of(const LsOptions& options) {
  if (options.pattern.empty()) return {};
  return {options.pattern};
}

// With --own the streams of this host, as with --host and its name.
Result<StreamFilter> filter_of(Session& session, const LsOptions& options) {
  std::vector<std::string> hosts = options.hosts;
  if (options.own) {
    const DaemonInfo daemon = DSSM_TRY(session.daemon_info());
    hosts = {daemon.host};
  }
  return StreamFilter(std::move(hosts), patterns_of(options));
}

}  // namespace

Result<void> run(const LsOptions& options, Output& out) {
  Session session = DSSM_TRY(connect(options));
  DSSM_TRY(check_hosts(session, options.hosts));
  if (options.watch) {
    return watch_streams(session, options, DSSM_TRY(filter_of(session, options)), out);
  }
  std::vector<StreamInfo> streams =
      DSSM_TRY(options.own ? session.list_own_streams() : session.list_streams());
  sort_streams(streams, options.sort);
  if (options.reverse) std::reverse(streams.begin(), streams.end());

  const std::size_t all = streams.size();
  const StreamFilter filter(options.hosts, patterns_of(options));
  if (options.names) return print_names(session, streams, filter, out);
  StreamListing listing;
  if (!options.own) listing.duplicates.emplace(streams);
  std::erase_if(streams, [&](const StreamInfo& stream) { return !filter.takes(stream.id); });
  listing.streams = std::move(streams);
  if (options.json) {
    print_json(listing, out);
  } else {
    print_table(listing, out);
    if (listing.streams.empty()) {
      out.flush();
      print_error(fmt::format("dssmctl: ls: {}\n", why_empty(session, options, all)));
    }
  }
  return {};
}

}  // namespace dssm::ctl
