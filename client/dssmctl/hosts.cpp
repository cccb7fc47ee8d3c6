// SPDX-License-Identifier: Apache-2.0
//
// dssmctl hosts: this PC and those that its dssmd knows, one row per way to reach one. A host that
// is down is what a person wants to see here, so it is no failure.
#include <set>

#include "client/dssmctl/json.hpp"
#include "client/dssmctl/open_stream.hpp"
#include "client/dssmctl/table.hpp"
#include "client/dssmctl/text.hpp"
#include "client/dssmctl/verbs.hpp"

namespace dssm::ctl {
namespace {

Json round_trip_json(Duration round_trip) {
  return round_trip > Duration::zero() ? Json(to_ns(round_trip)) : Json();
}

Json host_json(const HostInfo& host) {
  const auto or_null = [](const std::string& text) { return text.empty() ? Json() : Json(text); };
  Json json;
  json["host"] = or_null(host.name);
  json["state"] = host.state;
  json["state_for_ns"] = to_ns(host.since);
  json["addresses"] = host.addresses;
  json["version"] = or_null(host.version);
  json["round_trip_ns"] = round_trip_json(host.round_trip);
  json["least_round_trip_ns"] = round_trip_json(host.least_round_trip);
  json["streams"] = host.streams;
  json["clock_bound_ns"] = bound_json(host.clock_bound);
  json["insecure"] = host.insecure;
  json["error"] = or_null(host.error);
  return json;
}

std::string note(const HostInfo& host) {
  std::string text = host.insecure ? "insecure: nothing is encrypted" : "";
  if (!host.error.empty()) text += (text.empty() ? "" : "; ") + escaped_message(host.error);
  return text;
}

std::vector<std::string> row(const HostInfo& host) {
  const auto or_dash = [](std::string text) { return text.empty() ? "-" : std::move(text); };
  return {or_dash(escaped(host.name)),
          escaped(host.state),
          or_dash(list_text(host.addresses)),
          or_dash(escaped(host.version)),
          host.round_trip > Duration::zero() ? duration_text(host.round_trip) : "-",
          std::to_string(host.streams),
          bound_text(host.clock_bound),
          note(host)};
}

// Each name once: a host with several addresses has a row for each, one that never answered has no
// name yet.
void print_names(const std::vector<HostInfo>& hosts, Output& out) {
  std::set<std::string> names;
  for (const HostInfo& host : hosts) {
    if (host.name.empty() || !names.insert(host.name).second) continue;
    out.add(escaped(host.name) + "\n");
  }
}

}  // namespace

Result<void> run_hosts(const Options& options, Output& out) {
  Result<Session> session = connect(options);
  if (!session) return std::move(session).error();
  const Result<std::vector<HostInfo>> hosts = session->hosts();
  if (!hosts) return hosts.error();
  if (options.json) {
    Json all = Json::array();
    for (const HostInfo& host : *hosts) all.push_back(host_json(host));
    out.add(json_document({{"hosts", std::move(all)}}));
    return {};
  }
  if (options.names) {
    print_names(*hosts, out);
    return {};
  }
  constexpr auto kRight = Table::Align::right;
  Table table({{"HOST"},
               {"STATE"},
               {"ADDRESS"},
               {"VERSION"},
               {"RTT", kRight},
               {"STREAMS", kRight},
               {"CLOCK", kRight},
               {"NOTE"}});
  for (const HostInfo& host : *hosts) table.add_row(row(host));
  table.print(out);
  return {};
}

}  // namespace dssm::ctl
