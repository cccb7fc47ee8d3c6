// SPDX-License-Identifier: Apache-2.0
//
// dssmctl clock: how good the fleet's clocks are, a row per host, or per pair of hosts (--matrix);
// as it changes (--watch), as a table of statistics (--table), or as something to wait for
// (--wait).
#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <dssm/clock.hpp>
#include <map>
#include <thread>

#include "client/dssmctl/describe.hpp"
#include "client/dssmctl/open_stream.hpp"
#include "client/dssmctl/options.hpp"
#include "client/dssmctl/output.hpp"
#include "client/dssmctl/statistics.hpp"
#include "client/dssmctl/text.hpp"
#include "core/base/try.hpp"

namespace dssm::ctl {
namespace {

constexpr Duration kReadingPeriod = std::chrono::seconds(1);  // as often as hosts send their clocks

std::string reference_text(const HostInfo& host) {
  if (host.clock->basis == ClockBasis::own) return "itself";
  return or_dash(escaped(host.clock_reference));
}

const char* reads_text(const std::string& reason, bool refused) {
  return reason.empty() ? "good" : refused ? "refused" : "marked";
}

// What reads by time do with its samples here; nullptr: it is this PC.
const char* reads_text(const HostInfo& host) {
  if (host.state == HostState::self) return nullptr;
  return reads_text(host.clock_reason, host.clock_refused);
}

// Whether its chronyd was read.
bool is_read(const ClockSnapshot& clock) {
  return clock.status != ClockStatus::unknown && clock.age > Duration::zero();
}

// A host whose clock is not known has dashes.
std::vector<std::string> clock_row(const HostInfo& host) {
  const std::string reads = reads_text(host) ? reads_text(host) : "-";
  const std::string reason = escaped_message(host.clock_reason);
  if (!host.clock) {
    return {escaped(host.name), "-", "unknown", "-", "-", "-", "-", "-", reads, reason};
  }
  const ClockSnapshot& clock = *host.clock;
  return {escaped(host.name),
          status_text(clock),
          bound_text(host.clock_bound()),
          bound_text(host.clock_distance),
          is_read(clock) ? duration_text(clock.offset) : "-",
          reference_text(host),
          clock.update_interval > Duration::zero() ? duration_text(clock.update_interval) : "-",
          is_read(clock) ? duration_text(clock.age) : "-",
          reads,
          reason};
}

Json clock_json(const HostInfo& host) {
  Json json;
  json["host"] = host.name;
  json["state"] = name_of(host.state);
  const ClockSnapshot clock = host.clock.value_or(ClockSnapshot());
  json["status"] = name_of(clock.status);
  json["reason"] = clock.reason == ClockReason::none ? Json() : Json(name_of(clock.reason));
  json["basis"] = name_of(clock.basis);
  json["bound_ns"] = bound_json(host.clock_bound());
  json["distance_ns"] = bound_json(host.clock_distance);
  json["root_bound_ns"] = bound_json(clock.root_bound);
  json["offset_ns"] = is_read(clock) ? Json(to_ns(clock.offset)) : Json();
  json["reference"] = or_null(host.clock_reference);
  json["stratum"] = is_read(clock) ? Json(clock.stratum) : Json();
  json["poll_ns"] =
      clock.update_interval > Duration::zero() ? Json(to_ns(clock.update_interval)) : Json();
  json["age_ns"] = is_read(clock) ? Json(to_ns(clock.age)) : Json();
  const char* const reads = reads_text(host);
  json["reads"] = reads ? Json(reads) : Json();
  json["reads_reason"] = or_null(host.clock_reason);
  return json;
}

void print_clocks(const std::vector<HostInfo>& hosts, const ClockOptions& options, Output& out) {
  if (options.json) {
    Json all = Json::array();
    for (const HostInfo& host : hosts) {
      if (is_up(host.state)) all.push_back(clock_json(host));
    }
    return out.add(json_output({{"clocks", std::move(all)}}, options.watch));
  }
  Table table({{"HOST"},
               {"STATUS"},
               {"BOUND", Table::Align::right},
               {"FROM HERE", Table::Align::right},
               {"OFFSET", Table::Align::right},
               {"REFERENCE", Table::Align::left, 3},
               {"POLL", Table::Align::right, 1},
               {"AGE", Table::Align::right, 2},
               {"READS"},
               {"REASON", Table::Align::left, 0, Table::Column::Fit::below}});
  for (const HostInfo& host : hosts) {
    if (is_up(host.state)) table.add_row(clock_row(host));
  }
  table.print(out);
}

std::string bound_cell(Duration bound) {
  return bound == kUnknownClockError ? "-" : duration_text(bound);
}

std::vector<std::string> pair_row(const ClockPair& pair) {
  const std::string reader = or_dash(escaped(pair.reader)), owner = or_dash(escaped(pair.owner));
  if (!pair.error.empty()) {
    return {reader, owner, "-", "-", "-", "-", "-", "-", "-", "-", escaped_message(pair.error)};
  }
  return {reader,
          owner,
          reads_text(pair.reason, pair.refused),
          bound_text(pair.bound),
          bar_text(pair.bound, pair.limit),
          duration_text(pair.limit),
          pair.basis == DistanceBasis::nothing ? "-" : std::string(name_of(pair.basis)),
          bound_cell(pair.chain),
          bound_cell(pair.measured),
          pair.round_trip > Duration::zero() ? duration_text(pair.round_trip) : "-",
          escaped_message(pair.reason)};
}

Json pair_json(const ClockPair& pair) {
  const bool is_known = pair.error.empty();
  const bool is_measured = pair.round_trip > Duration::zero();
  return {{"reader", pair.reader},
          {"owner", or_null(pair.owner)},
          {"reads", is_known ? Json(reads_text(pair.reason, pair.refused)) : Json()},
          {"reads_reason", or_null(pair.reason)},
          {"bound_ns", bound_json(pair.bound)},
          {"limit_ns", is_known ? Json(to_ns(pair.limit)) : Json()},
          {"known_by", pair.basis == DistanceBasis::nothing ? Json() : Json(name_of(pair.basis))},
          {"chain_ns", bound_json(pair.chain)},
          {"measured_ns", bound_json(pair.measured)},
          {"round_trip_ns", is_measured ? Json(to_ns(pair.round_trip)) : Json()},
          {"error", or_null(pair.error)}};
}

void print_matrix(const std::vector<ClockPair>& pairs, const ClockOptions& options, Output& out) {
  if (options.json) {
    Json all = Json::array();
    for (const ClockPair& pair : pairs) all.push_back(pair_json(pair));
    return out.add(json_output({{"clock_pairs", std::move(all)}}, options.watch));
  }
  Table table({{"ON"},
               {"OF"},
               {"READS"},
               {"BOUND", Table::Align::right},
               {"OF LIMIT"},
               {"LIMIT", Table::Align::right, 4},
               {"KNOWN BY", Table::Align::left, 5},
               {"CHAIN", Table::Align::right, 2},
               {"MEASURED", Table::Align::right, 3},
               {"RTT", Table::Align::right, 1},
               {"REASON", Table::Align::left, 0, Table::Column::Fit::below}});
  for (const ClockPair& pair : pairs) table.add_row(pair_row(pair));
  table.print(out);
  if (pairs.empty()) out.add("no other host is up, so there is no pair; see `dssmctl hosts`\n");
}

Result<void> print_once(Session& session, const ClockOptions& options, Output& out) {
  if (options.matrix) {
    print_matrix(DSSM_TRY(session.list_clock_pairs()), options, out);
  } else {
    print_clocks(DSSM_TRY(session.list_hosts()), options, out);
  }
  return {};
}

// What was read of one host.
struct Readings {
  explicit Readings(std::size_t count) : offsets(count), bounds(count) {}
  Window offsets, bounds;  // of the offset only its size
  std::size_t unknown = 0;
};

Json statistics_json(const Statistics& statistics) {
  const auto when_read = [&](auto value) { return statistics.count > 0 ? Json(value) : Json(); };
  return {{"readings", statistics.count},
          {"average_ns", when_read(statistics.mean_ns)},
          {"max_ns", when_read(to_ns(statistics.max))},
          {"min_ns", when_read(to_ns(statistics.min))},
          {"std_dev_ns", when_read(statistics.std_dev_ns)}};
}

void print_table(const std::map<std::string, Readings>& all, bool json, Output& out) {
  if (json) {
    Json hosts = Json::array();
    for (const auto& [name, readings] : all) {
      hosts.push_back({{"host", name},
                       {"offset", statistics_json(readings.offsets.statistics())},
                       {"bound", statistics_json(readings.bounds.statistics())},
                       {"unknown", readings.unknown}});
    }
    return out.add(json_document({{"clocks", std::move(hosts)}}));
  }
  Table table({{"HOST"},
               {"OF"},
               {"READINGS", Table::Align::right},
               {"AVERAGE", Table::Align::right},
               {"MAX", Table::Align::right},
               {"MIN", Table::Align::right},
               {"STD DEV", Table::Align::right}});
  for (const auto& [name, readings] : all) {
    for (const auto& [what, window] :
         {std::pair("offset", &readings.offsets), std::pair("bound", &readings.bounds)}) {
      const Statistics found = window->statistics();
      const auto cell = [&](const std::string& text) { return found.count > 0 ? text : "-"; };
      table.add_row({escaped(name), what, std::to_string(found.count), cell(ns_text(found.mean_ns)),
                     cell(duration_text(found.max)), cell(duration_text(found.min)),
                     cell(ns_text(found.std_dev_ns))});
    }
  }
  table.print(out);
  for (const auto& [name, readings] : all) {
    if (readings.unknown == 0) continue;
    out.add(fmt::format("at {} readings the clock of '{}' was not known\n", readings.unknown,
                        escaped(name)));
  }
}

Result<void> tabulate_clocks(Session& session, const ClockOptions& options, Output& out) {
  catch_stop_signals();
  const std::uint64_t count = *options.table;
  std::map<std::string, Readings> all;
  MonoTime next = MonoClock::now();
  for (std::uint64_t i = 0; i < count; ++i, next += kReadingPeriod) {
    if (!out.sleep_until(next)) break;
    const std::vector<HostInfo> hosts = DSSM_TRY(session.list_hosts());
    for (const HostInfo& host : hosts) {
      if (!is_up(host.state)) continue;
      Readings& readings = all.try_emplace(host.name, count).first->second;
      if (!host.clock || host.clock_bound() == kUnknownClockError) {
        ++readings.unknown;
        continue;
      }
      readings.offsets.add(std::max(host.clock->offset, -host.clock->offset));
      readings.bounds.add(host.clock_bound());
    }
  }
  print_table(all, options.json, out);
  return {};
}

// Why reads by time do not accept the samples of all hosts that are up; empty: they do. Where no
// other host is up, this one's clock counts.
std::optional<Error> not_good(const std::vector<HostInfo>& hosts) {
  bool is_alone = true;
  for (const HostInfo& host : hosts) {
    if (!is_up(host.state) || host.state == HostState::self) continue;
    is_alone = false;
    if (!host.clock_reason.empty()) {
      return Error{Errc::clock_out_of_bounds,
                   fmt::format("the times of '{}''s samples are not good here: {}", host.name,
                               host.clock_reason)};
    }
  }
  const HostInfo& self = hosts.front();
  if (!is_alone || (self.clock && is_good(*self.clock))) return std::nullopt;
  return Error{Errc::clock_out_of_bounds,
               fmt::format("no other host is up, and the clock of this host is {}; see `chronyc "
                           "tracking` and `systemctl status chrony`",
                           self.clock ? status_text(*self.clock) : "not watched")};
}

// Waits until the clocks are good enough; prints this host's, or fails with the reason.
Result<void> await_clock(Session& session, const ClockOptions& options, Output& out) {
  catch_stop_signals();
  const MonoTime deadline = deadline_in(*options.wait);
  for (bool is_first = true;; is_first = false) {
    const std::vector<HostInfo> hosts = DSSM_TRY(session.list_hosts());
    const std::optional<Error> bad = not_good(hosts);
    if (!bad) {
      print_clocks({hosts.front()}, options, out);
      return {};
    }
    const MonoTime now = MonoClock::now();
    if (now >= deadline || stop_requested()) return *bad;
    if (is_first) print_waiting(options, *options.wait, *bad);
    std::this_thread::sleep_for(std::min(deadline - now, kStopCheckPeriod));
  }
}

}  // namespace

Result<void> run(const ClockOptions& options, Output& out) {
  Session session = DSSM_TRY(connect(options));
  if (options.wait) return await_clock(session, options, out);
  if (options.table) return tabulate_clocks(session, options, out);
  return print_once_or_watch(options.watch, options.json, out,
                             [&] { return print_once(session, options, out); });
}

}  // namespace dssm::ctl
