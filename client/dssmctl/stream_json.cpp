// SPDX-License-Identifier: Apache-2.0
#include "client/dssmctl/stream_json.hpp"

#include "client/dssmctl/text.hpp"

namespace dssm::ctl {

namespace {

Json mirror_json(const MirrorInfo& mirror) {
  return {{"state", name_of(mirror.state)},
          {"newest_tid", mirror.newest != kNoTid ? Json(mirror.newest) : Json()},
          {"received_samples", mirror.received_samples},
          {"received_bytes", mirror.received_bytes},
          {"gap_samples", mirror.gap_samples},
          {"reconnects", mirror.reconnects},
          {"restarts", mirror.restarts},
          {"clock", mirror.clock.empty() ? Json() : Json(mirror.clock)},
          {"error", mirror.error.empty() ? Json() : Json(mirror.error)}};
}

}  // namespace

Json stream_json(const StreamInfo& stream, Time now) {
  const bool written = stream.newest != kNoTid;
  const auto when_written = [&](std::int64_t value) { return written ? Json(value) : Json(); };
  Json json;
  json["stream"] = stream.id.str();
  json["name"] = stream.id.name;
  json["id"] = stream.id.id;
  json["host"] = stream.id.host;
  json["type"] = stream.type.name.empty() ? Json() : Json(stream.type.name);
  json["payload_bytes"] = stream.type.payload_bytes;
  json["depth"] = stream.depth;
  json["cycle_ns"] = to_ns(stream.cycle);
  json["rate_hz"] = stream.rate_hz > 0 ? Json(stream.rate_hz) : Json();
  json["age_ns"] = when_written(to_ns(saturating_sub(now, stream.newest_time)));
  json["oldest_tid"] = when_written(stream.oldest);
  json["newest_tid"] = when_written(stream.newest);
  json["newest_time_ns"] = when_written(to_ns(stream.newest_time));
  json["writers"] = stream.writers;
  json["readers"] = stream.readers;
  json["channels"] = stream.channels;
  json["memory_bytes"] = stream.memory_bytes;
  json["property_bytes"] = stream.property_bytes;
  json["incarnation"] = stream.incarnation;
  json["creator_pid"] = stream.creator_pid;
  return json;
}

void add_details(Json& json, const StreamInfo& stream) {
  json["alignment_bytes"] = stream.type.alignment_bytes;
  Json& fields = json["fields"] = Json::array();
  for (const Field& field : stream.type.fields) {
    fields.push_back({{"name", field.name},
                      {"kind", name_of(field.kind)},
                      {"offset_bytes", field.offset_bytes},
                      {"count", field.count},
                      {"stride_bytes", field.stride_bytes}});
  }
  Json& users = json["users"] = Json::array();
  for (const StreamUser& user : stream.users) {
    users.push_back({{"role", role_name(user.role)},
                     {"pid", user.pid},
                     {"uid", user.uid},
                     {"program", user.program}});
  }
  json["mirror"] = stream.mirror ? mirror_json(*stream.mirror) : Json();
}

std::string_view role_name(Role role) { return role == Role::writer ? "writer" : "reader"; }

}  // namespace dssm::ctl
