// SPDX-License-Identifier: Apache-2.0
//
// dssmctl ls: all streams of all hosts, own ones first, each host's in the order of their creation
// without --sort. One request to dssmd (two for names or hosts), one write; it is run in
// loops and by the shell's completion, so it has to be quick.
#include <algorithm>
#include <set>

#include "client/dssmctl/duplicates.hpp"
#include "client/dssmctl/ls_watch.hpp"
#include "client/dssmctl/names.hpp"
#include "client/dssmctl/open_stream.hpp"
#include "client/dssmctl/stream_json.hpp"
#include "client/dssmctl/table.hpp"
#include "client/dssmctl/text.hpp"
#include "client/dssmctl/verbs.hpp"

namespace dssm::ctl {
namespace {

// Sorts by what `key` gives, keeping the order of creation among equals.
template <class Key>
void sort_by(std::vector<StreamInfo>& streams, Key key) {
  std::stable_sort(streams.begin(), streams.end(),
                   [&](const StreamInfo& a, const StreamInfo& b) { return key(a) < key(b); });
}

// Numbers rise; streams that were never written to come last in "age".
void sort_streams(std::vector<StreamInfo>& streams, const std::string& key) {
  if (key == "name")
    return sort_by(streams, [](const auto& s) { return std::pair(s.id.name, s.id.id); });
  if (key == "id")
    return sort_by(streams, [](const auto& s) { return std::pair(s.id.id, s.id.name); });
  if (key == "host") return sort_by(streams, [](const auto& s) { return s.id.host; });
  if (key == "size") return sort_by(streams, [](const auto& s) { return s.type.payload_bytes; });
  if (key == "depth") return sort_by(streams, [](const auto& s) { return s.depth; });
  if (key == "cycle") return sort_by(streams, [](const auto& s) { return s.cycle; });
  if (key == "rate") return sort_by(streams, [](const auto& s) { return s.rate_hz; });
  if (key == "writers") return sort_by(streams, [](const auto& s) { return s.writers; });
  if (key == "readers") return sort_by(streams, [](const auto& s) { return s.readers; });
  if (key == "type") return sort_by(streams, [](const auto& s) { return s.type.name; });
  if (key == "memory") return sort_by(streams, [](const auto& s) { return s.memory_bytes; });
  if (key == "age") {
    return sort_by(streams, [](const auto& s) {
      const bool never = s.newest == kNoTid;
      return std::pair(never, never ? Time::max() : time_from_ns(~to_ns(s.newest_time)));
    });
  }
}

std::string rate_text(double rate_hz) { return rate_hz > 0 ? fixed_text(rate_hz, 1) + " Hz" : "-"; }

constexpr std::string_view kDuplicateMark = " *";

std::vector<std::string> row(const StreamInfo& stream, bool duplicate, Time now) {
  return {
      escaped(stream.id.name).append(duplicate ? kDuplicateMark : ""),
      std::to_string(stream.id.id),
      escaped(stream.id.host),
      std::to_string(stream.type.payload_bytes),
      std::to_string(stream.depth),
      duration_text(stream.cycle),
      rate_text(stream.rate_hz),
      stream.newest == kNoTid ? "-" : duration_text(saturating_sub(now, stream.newest_time)),
      std::to_string(stream.writers),
      std::to_string(stream.readers),
      stream.type.name.empty() ? "-" : escaped(stream.type.name),
  };
}

// What to show, in order. The marks follow from all that there is, shown or not; without the
// other hosts' streams they are not known.
struct Listing {
  std::vector<StreamInfo> streams;
  std::optional<Duplicates> duplicates;

  bool duplicate(const StreamInfo& stream) const {
    return duplicates && duplicates->has(stream.id);
  }
};

// One document, but a line per stream: with a thousand of them neither a tree of values in memory
// nor indentation is worth its time.
void print_json(const Listing& listing, Time now, Output& out) {
  out.add("{\"streams\":[");
  std::string_view separator = "\n";
  for (const StreamInfo& stream : listing.streams) {
    Json json = stream_json(stream, now);
    json["duplicate"] = listing.duplicates ? Json(listing.duplicate(stream)) : Json();
    out.add(separator);
    out.add(json_text(json));
    separator = ",\n";
  }
  out.add("\n]}\n");
}

void print_table(const Listing& listing, Time now, Output& out) {
  constexpr auto kRight = Table::Align::right;
  Table table({{"NAME"},
               {"ID", kRight},
               {"HOST"},
               {"SIZE", kRight},
               {"DEPTH", kRight},
               {"CYCLE", kRight},
               {"RATE", kRight},
               {"AGE", kRight},
               {"WRITERS", kRight},
               {"READERS", kRight},
               {"TYPE"}});
  const StreamInfo* marked = nullptr;
  for (const StreamInfo& stream : listing.streams) {
    const bool duplicate = listing.duplicate(stream);
    if (duplicate) marked = &stream;
    table.add_row(row(stream, duplicate, now));
  }
  table.print(out);
  if (marked) {
    out.add("* several hosts have a stream of this name and id: say which one, as in " +
            escaped(marked->id.str()) + "\n");
  }
}

// A program must get a name as it is; a terminal must not.
Result<void> print_names(Session& session, const std::vector<StreamInfo>& all,
                         const StreamFilter& filter, Output& out) {
  const Result<DaemonInfo> daemon = session.daemon_info();
  if (!daemon) return daemon.error();
  const std::vector<std::string> names = opening_names(all, daemon->host);
  for (std::size_t i = 0; i < all.size(); ++i) {
    if (!filter.takes(all[i].id)) continue;
    out.add((out.terminal() ? escaped(names[i]) : names[i]) + "\n");
  }
  return {};
}

// A name that no host has would show nothing forever.
Result<void> check_hosts(Session& session, const std::vector<std::string>& wanted) {
  if (wanted.empty()) return {};
  const Result<std::vector<HostInfo>> hosts = session.list_hosts();
  if (!hosts) return hosts.error();
  std::set<std::string> known;
  for (const HostInfo& host : *hosts) {
    if (!host.name.empty()) known.insert(host.name);
  }
  for (const std::string& name : wanted) {
    if (known.contains(name)) continue;
    Error error{Errc::not_found,
                "list the streams of host '" + name + "': no such host is known here; known"};
    std::string_view separator = " are '";
    for (const std::string& other : known) {
      error.message.append(separator).append(other).append("'");
      separator = ", '";
    }
    error.message += "; see `dssmctl hosts`";
    return error;
  }
  return {};
}

// With --own the streams of this host, as with --host and its name.
Result<StreamFilter> filter_of(Session& session, const LsOptions& options) {
  std::vector<std::string> hosts = options.hosts;
  if (options.own) {
    const Result<DaemonInfo> daemon = session.daemon_info();
    if (!daemon) return daemon.error();
    hosts = {daemon->host};
  }
  return StreamFilter(std::move(hosts), options.pattern);
}

}  // namespace

Result<void> run(const LsOptions& options, Output& out) {
  Result<Session> session = connect(options);
  if (!session) return std::move(session).error();
  if (Result<void> known = check_hosts(*session, options.hosts); !known) return known;
  if (options.watch) {
    const Result<StreamFilter> filter = filter_of(*session, options);
    return filter ? watch_streams(*session, options, *filter, out) : filter.error();
  }
  Result<std::vector<StreamInfo>> streams =
      options.own ? session->list_own_streams() : session->list_streams();
  if (!streams) return std::move(streams).error();
  sort_streams(*streams, options.sort);
  if (options.reverse) std::reverse(streams->begin(), streams->end());

  const StreamFilter filter(options.hosts, options.pattern);
  if (options.names) return print_names(*session, *streams, filter, out);
  Listing listing;
  if (!options.own) listing.duplicates.emplace(*streams);
  std::erase_if(*streams, [&](const StreamInfo& stream) { return !filter.takes(stream.id); });
  listing.streams = std::move(*streams);
  const Time now = WallClock::now();
  options.json ? print_json(listing, now, out) : print_table(listing, now, out);
  return {};
}

}  // namespace dssm::ctl
