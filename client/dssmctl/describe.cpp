// SPDX-License-Identifier: Apache-2.0
#include "client/dssmctl/describe.hpp"

#include <fmt/chrono.h>
#include <fmt/format.h>

#include <cmath>
#include <ctime>
#include <optional>

#include "client/dssmctl/black_box_streams.hpp"
#include "client/dssmctl/text.hpp"

namespace dssm::ctl {
namespace {

Json round_trip_json(Duration round_trip) {
  return round_trip > Duration::zero() ? Json(to_ns(round_trip)) : Json();
}

std::string note(const HostInfo& host) {
  std::string text = host.insecure ? "insecure: nothing is encrypted" : "";
  const auto add = [&](const std::string& more) { text += (text.empty() ? "" : "; ") + more; };
  if (const std::uint64_t carried = host.carried_bytes_per_s; carried > 0) {
    add("the network carries " + byte_rate_text(static_cast<double>(carried)) + " from there");
  }
  if (!host.error.empty()) add(escaped_message(host.error));
  return text;
}

// What comes to a mirror whose network does not carry what is asked for.
struct Carried {
  double samples_per_s = 0, asked_per_s = 0, bytes_per_s = 0;
};

std::optional<Carried> carried_of(const StreamInfo& stream) {
  if (!stream.mirror || stream.mirror->recent_lost_samples == 0) return {};
  // What was counted before the owner was down says nothing of the network now.
  const MirrorInfo& mirror = *stream.mirror;
  if (!gets_samples(mirror) || stream.rate_hz <= 0) return {};
  const double share = 1 - static_cast<double>(mirror.recent_lost_samples) /
                               static_cast<double>(mirror.recent_samples);
  Carried carried{share * stream.rate_hz, stream.rate_hz};
  if (mirror.max_rate_hz > 0) {
    constexpr double kClearly = 0.8;  // timers come late, so the rate is a little lower anyway
    carried.asked_per_s = std::min(mirror.max_rate_hz, stream.rate_hz);
    if (carried.samples_per_s >= kClearly * carried.asked_per_s) return {};
  }
  // Samples may have different lengths: as long as those that came are on the whole.
  if (mirror.received_samples > 0) {
    carried.bytes_per_s = carried.samples_per_s * static_cast<double>(mirror.received_bytes) /
                          static_cast<double>(mirror.received_samples);
  }
  return carried;
}

}  // namespace

Json mirror_json(const StreamInfo& stream) {
  const MirrorInfo& mirror = *stream.mirror;
  const Duration behind = behind_owner(stream);
  const std::optional<Carried> carried = carried_of(stream);
  const bool is_behind = mirror.state == MirrorState::live && behind > Duration();
  return {{"state", is_behind ? "behind" : name_of(mirror.state)},
          {"behind_ns", to_ns(behind)},
          {"newest_tid", mirror.newest != kNoTid ? Json(mirror.newest) : Json()},
          {"newest_time_ns", mirror.newest != kNoTid ? Json(to_ns(mirror.newest_time)) : Json()},
          {"received_samples", mirror.received_samples},
          {"received_bytes", mirror.received_bytes},
          {"gap_samples", mirror.gap_samples},
          {"filling_samples", mirror.filling_samples},
          {"history_wanted", mirror.history_wanted},
          {"recent_samples", mirror.recent_samples},
          {"recent_lost_samples", mirror.recent_lost_samples},
          {"carried_bytes_per_s", carried ? Json(std::llround(carried->bytes_per_s)) : Json()},
          {"depth", mirror.depth > 0 ? Json(mirror.depth) : Json()},
          {"max_rate_hz", mirror.max_rate_hz > 0 ? Json(mirror.max_rate_hz) : Json()},
          {"reconnects", mirror.reconnects},
          {"restarts", mirror.restarts},
          {"clock", or_null(mirror.clock)},
          {"clock_refused", mirror.clock_refused},
          {"error", or_null(mirror.error)}};
}

bool is_up(HostState state) { return state == HostState::self || state == HostState::up; }

bool is_good(const ClockSnapshot& clock) {
  return clock.status == ClockStatus::synchronized || clock.status == ClockStatus::holdover;
}

std::string status_text(const ClockSnapshot& clock) {
  if (clock.reason == ClockReason::none) return std::string(name_of(clock.status));
  return fmt::format("{}: {}", name_of(clock.status), name_of(clock.reason));
}

Json host_json(const HostInfo& host) {
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
  json["carried_bytes_per_s"] =
      host.carried_bytes_per_s > 0 ? Json(host.carried_bytes_per_s) : Json();
  json["streams"] = is_up(host.state) ? Json(host.streams) : Json();
  json["clock_bound_ns"] = bound_json(host.clock_bound());
  json["clock_distance_ns"] = bound_json(host.clock_distance);
  json["insecure"] = host.insecure;
  json["reason"] = host.reason == HostReason::none ? Json() : Json(name_of(host.reason));
  json["error"] = or_null(host.error);
  return json;
}

std::string validity_text(const CredentialsInfo& credentials) {
  const std::time_t until = to_ns(credentials.valid_until) / 1'000'000'000;
  return fmt::format("valid until {:%Y-%m-%d}", fmt::gmtime(until));
}

std::vector<Table::Column> host_columns() {
  constexpr auto kRight = Table::Align::right;
  return {{"HOST"},
          {"STATE"},
          {"ADDRESS"},
          {"FOUND BY", Table::Align::left, 1},
          {"VERSION", Table::Align::left, 2},
          {"RTT", kRight},
          {"STREAMS", kRight},
          {"CLOCK", kRight},
          {"NOTE", Table::Align::left, 0, Table::Column::Fit::below}};
}

std::vector<std::string> host_row(const HostInfo& host) {
  return {or_dash(escaped(host.name)),
          std::string(name_of(host.state)),
          or_dash(list_text(host.addresses)),
          or_dash(list_text(host.found_by)),
          or_dash(escaped(host.version)),
          host.round_trip > Duration::zero() ? duration_text(host.round_trip) : "-",
          is_up(host.state) ? std::to_string(host.streams) : "-",
          bound_text(host.clock_bound()),
          note(host)};
}

bool is_silent(const StreamInfo& stream) {
  return (stream.state == StreamState::stalled || stream.state == StreamState::no_writer) &&
         !is_of_black_box(stream.id);
}

bool is_age_known(const StreamInfo& stream) {
  return stream.state == StreamState::live || stream.state == StreamState::stalled ||
         stream.state == StreamState::no_writer;
}

bool is_use_known(const StreamInfo& stream) {
  if (stream.mirror && stream.mirror->state == MirrorState::owner_unavailable) return false;
  return stream.state != StreamState::unknown || stream.newest != kNoTid;
}

std::string rate_text(const StreamInfo& stream) {
  return stream.rate_hz > 0 && !is_silent(stream) ? fmt::format("{:.1f} Hz", stream.rate_hz) : "-";
}

std::string age_text(const StreamInfo& stream) {
  return is_age_known(stream) ? duration_text(stream.age) : "-";
}

std::string state_cell(const StreamInfo& stream) {
  return stream.state == StreamState::unknown ? "-" : std::string(name_of(stream.state));
}

std::string count_text(const StreamInfo& stream, std::uint32_t users) {
  return is_use_known(stream) ? std::to_string(users) : "-";
}

Json stream_json(const StreamInfo& stream) {
  const bool written = stream.newest != kNoTid;
  const auto when_written = [&](std::int64_t value) { return written ? Json(value) : Json(); };
  Json json;
  json["stream"] = stream.id.str();
  json["name"] = stream.id.name;
  json["id"] = stream.id.id;
  json["host"] = stream.id.host;
  json["type"] = or_null(stream.type.name);
  json["payload_bytes"] = stream.type.payload_bytes;
  json["depth"] = stream.depth;
  json["cycle_ns"] = to_ns(stream.cycle);
  const bool has_state = stream.state != StreamState::unknown;
  json["state"] = has_state ? Json(name_of(stream.state)) : Json();
  json["rate_hz"] = stream.rate_hz > 0 && !is_silent(stream) ? Json(stream.rate_hz) : Json();
  json["age_ns"] = is_age_known(stream) ? Json(to_ns(stream.age)) : Json();
  json["oldest_tid"] = when_written(stream.oldest);
  json["newest_tid"] = when_written(stream.newest);
  json["newest_time_ns"] = when_written(to_ns(stream.newest_time));
  const auto when_known = [&](std::uint32_t n) { return is_use_known(stream) ? Json(n) : Json(); };
  json["writers"] = when_known(stream.writers);
  json["readers"] = when_known(stream.readers);
  json["remote_writers"] = when_known(stream.remote_writers);
  json["remote_readers"] = when_known(stream.remote_readers);
  json["channels"] = when_known(stream.channels);
  json["crashed_writers"] = stream.crashed_writers;
  json["last_crashed_writer"] = or_null(stream.last_crashed_writer);
  json["crashed_readers"] = stream.crashed_readers;
  json["last_crashed_reader"] = or_null(stream.last_crashed_reader);
  json["memory_bytes"] = stream.memory_bytes;
  json["property_bytes"] = stream.property_bytes;
  json["incarnation"] = stream.incarnation;
  json["creator_pid"] = stream.creator_pid > 0 ? Json(stream.creator_pid) : Json();
  return json;
}

void print_fields(const TypeInfo& type, Output& out) {
  constexpr auto kRight = Table::Align::right;
  Table table({{"FIELD"}, {"KIND"}, {"OFFSET", kRight}, {"COUNT", kRight}, {"STRIDE", kRight}});
  for (const Field& field : type.fields) {
    const std::string bits = field.bits == 0 ? ""
                                             : fmt::format(" bit {} to {}", field.first_bit,
                                                           field.first_bit + field.bits - 1);
    table.add_row({escaped(field.name), std::string(name_of(field.kind)) + bits,
                   std::to_string(field.offset_bytes), std::to_string(field.count),
                   field.count > 1 ? std::to_string(field.stride_bytes) : "-"});
  }
  table.print(out);
}

Json fields_json(const TypeInfo& type) {
  Json fields = Json::array();
  for (const Field& field : type.fields) {
    fields.push_back({{"name", field.name},
                      {"kind", name_of(field.kind)},
                      {"offset_bytes", field.offset_bytes},
                      {"count", field.count},
                      {"stride_bytes", field.stride_bytes}});
    if (field.bits == 0) continue;
    fields.back()["first_bit"] = field.first_bit;
    fields.back()["bits"] = field.bits;
  }
  return fields;
}

void add_details(Json& json, const StreamInfo& stream) {
  json["alignment_bytes"] = stream.type.alignment_bytes;
  json["fields"] = fields_json(stream.type);
  Json& users = json["users"] = Json::array();
  for (const StreamUser& user : stream.users) {
    users.push_back({{"role", role_name(user.role)},
                     {"host", or_null(user.host)},
                     {"pid", user.pid > 0 ? Json(user.pid) : Json()},
                     {"uid", user.uid ? Json(*user.uid) : Json()},
                     {"program", or_null(user.program)},
                     {"via", name_of(user.via)}});
  }
  json["mirror"] = stream.mirror ? mirror_json(stream) : Json();
}

// Both times are of the owner's clock. A sample may be on its way, and the two were looked at one
// after the other.
Duration behind_owner(const StreamInfo& stream) {
  constexpr Duration kOnItsWay = std::chrono::milliseconds(100);
  if (!stream.mirror || stream.mirror->newest == kNoTid || stream.newest <= stream.mirror->newest) {
    return {};
  }
  const Duration behind = saturating_sub(stream.newest_time, stream.mirror->newest_time);
  const double rate_hz = stream.mirror->max_rate_hz;
  const Duration between =
      rate_hz > 0 ? std::max(stream.cycle, Duration(std::llround(1e9 / rate_hz))) : stream.cycle;
  return behind > 2 * between + kOnItsWay ? behind : Duration();
}

bool gets_samples(const MirrorInfo& mirror) {
  return mirror.state == MirrorState::live || mirror.state == MirrorState::filling;
}

std::string carried_text(const StreamInfo& stream) {
  const std::optional<Carried> carried = carried_of(stream);
  if (!carried) return {};
  const std::string bytes =
      carried->bytes_per_s > 0 ? fmt::format(" ({})", byte_rate_text(carried->bytes_per_s)) : "";
  const bool has_rate = stream.mirror->max_rate_hz > 0;
  return fmt::format("carries {:.3g} of {}{:.3g} samples a second{}{}", carried->samples_per_s,
                     has_rate ? "the " : "", carried->asked_per_s,
                     has_rate ? " that are asked for" : "", bytes);
}

std::string_view role_name(Role role) { return role == Role::writer ? "writer" : "reader"; }

}  // namespace dssm::ctl
