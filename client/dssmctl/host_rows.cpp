// SPDX-License-Identifier: Apache-2.0
#include "client/dssmctl/host_rows.hpp"

#include "client/dssmctl/text.hpp"

namespace dssm::ctl {
namespace {

Json round_trip_json(Duration round_trip) {
  return round_trip > Duration::zero() ? Json(to_ns(round_trip)) : Json();
}

std::string note(const HostInfo& host) {
  std::string text = host.insecure ? "insecure: nothing is encrypted" : "";
  if (!host.error.empty()) text += (text.empty() ? "" : "; ") + escaped_message(host.error);
  return text;
}

}  // namespace

Json host_json(const HostInfo& host) {
  const auto or_null = [](const std::string& text) { return text.empty() ? Json() : Json(text); };
  Json json;
  json["host"] = or_null(host.name);
  json["id"] = or_null(host.id);
  json["state"] = name_of(host.state);
  json["state_for_ns"] = to_ns(host.since);
  json["addresses"] = host.addresses;
  json["found_by"] = host.found_by;
  json["version"] = or_null(host.version);
  json["round_trip_ns"] = round_trip_json(host.round_trip);
  json["least_round_trip_ns"] = round_trip_json(host.min_round_trip);
  json["streams"] = host.streams;
  json["clock_bound_ns"] = bound_json(host.clock_bound());
  json["insecure"] = host.insecure;
  json["reason"] = host.reason == HostReason::none ? Json() : Json(name_of(host.reason));
  json["error"] = or_null(host.error);
  return json;
}

std::vector<Table::Column> host_columns() {
  constexpr auto kRight = Table::Align::right;
  return {{"HOST"},        {"STATE"},           {"ADDRESS"},       {"FOUND BY"}, {"VERSION"},
          {"RTT", kRight}, {"STREAMS", kRight}, {"CLOCK", kRight}, {"NOTE"}};
}

std::vector<std::string> host_row(const HostInfo& host) {
  const auto or_dash = [](std::string text) { return text.empty() ? "-" : std::move(text); };
  return {or_dash(escaped(host.name)),
          std::string(name_of(host.state)),
          or_dash(list_text(host.addresses)),
          or_dash(list_text(host.found_by)),
          or_dash(escaped(host.version)),
          host.round_trip > Duration::zero() ? duration_text(host.round_trip) : "-",
          std::to_string(host.streams),
          bound_text(host.clock_bound()),
          note(host)};
}

}  // namespace dssm::ctl
