// SPDX-License-Identifier: Apache-2.0
//
// dssmctl ls: all streams of all hosts, own ones first, each host's in the order of their creation
// unless told otherwise. One question to dssmd (two for names), one write; it is run in loops and
// by the shell's completion, so it has to be quick.
#include <algorithm>

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

std::vector<std::string> row(const StreamInfo& stream, Time now) {
  return {
      escaped(stream.id.name),
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

// One document, but a line per stream: with a thousand of them neither a tree of values in memory
// nor indentation is worth its time.
void print_json(const std::vector<StreamInfo>& streams, Time now, Output& out) {
  out.add("{\"streams\":[");
  std::string_view separator = "\n";
  for (const StreamInfo& stream : streams) {
    out.add(separator);
    out.add(json_text(stream_json(stream, now)));
    separator = ",\n";
  }
  out.add("\n]}\n");
}

// A program must get a name as it is; a terminal must not.
Result<void> print_names(Session& session, const std::vector<StreamInfo>& streams, Output& out) {
  const Result<DaemonInfo> daemon = session.daemon();
  if (!daemon) return daemon.error();
  for (const std::string& name : opening_names(streams, daemon->host)) {
    out.add((out.terminal() ? escaped(name) : name) + "\n");
  }
  return {};
}

void print_table(const std::vector<StreamInfo>& streams, Time now, Output& out) {
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
  for (const StreamInfo& stream : streams) table.add_row(row(stream, now));
  table.print(out);
}

}  // namespace

Result<void> run_ls(const Options& options, Output& out) {
  Result<Session> session = connect(options);
  if (!session) return std::move(session).error();
  Result<std::vector<StreamInfo>> streams = options.own ? session->list_own() : session->list();
  if (!streams) return std::move(streams).error();
  sort_streams(*streams, options.sort);
  if (options.reverse) std::reverse(streams->begin(), streams->end());

  if (options.names) return print_names(*session, *streams, out);
  const Time now = WallClock::now();
  options.json ? print_json(*streams, now, out) : print_table(*streams, now, out);
  return {};
}

}  // namespace dssm::ctl
