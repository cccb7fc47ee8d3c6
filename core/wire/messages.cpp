// SPDX-License-Identifier: Apache-2.0
#include "core/wire/messages.hpp"

#include <fmt/format.h>

#include <algorithm>

#include "core/base/text.hpp"
#include "core/base/try.hpp"
#include "core/wire/frame.hpp"
#include "network.pb.h"

namespace dssm::wire {
namespace {

TypeInfo type_info(const proto::Type& message) {
  TypeInfo type{message.name(), message.payload_bytes(), message.alignment_bytes(), {}};
  for (const proto::Field& field : message.fields()) {
    const auto small = [](std::uint32_t n) { return static_cast<std::uint8_t>(std::min(n, 255U)); };
    type.fields.push_back({field.name(), static_cast<Scalar>(field.scalar()), field.offset_bytes(),
                           field.count(), field.stride_bytes(), small(field.bits()),
                           small(field.first_bit())});
  }
  return type;
}

MirrorInfo mirror_info(const proto::Mirror& message) {
  return {enum_untrusted(message.state(), MirrorState::removed),
          message.gap_samples(),
          message.reconnects(),
          message.restarts(),
          message.newest(),
          time_from_ns(message.newest_time_ns()),
          message.received_samples(),
          message.received_bytes(),
          message.error(),
          message.clock(),
          message.clock_refused(),
          message.filling_samples(),
          message.history_wanted(),
          message.recent_samples(),
          message.recent_lost_samples(),
          message.max_rate_hz(),
          message.depth()};
}

}  // namespace

std::string text_untrusted(const std::string& text, std::size_t max_bytes) {
  std::string_view taken = std::string_view(text).substr(0, max_bytes);
  while (!is_utf8(taken)) taken.remove_suffix(1);
  return printable(taken);
}

void to_message(const StreamId& id, proto::StreamId& out) {
  out.set_name(id.name);
  out.set_id(id.id);
  out.set_host(id.host);
}

void to_message(const TypeInfo& type, proto::Type& out) {
  out.set_name(type.name);
  out.set_payload_bytes(type.payload_bytes);
  out.set_alignment_bytes(type.alignment_bytes);
  for (const Field& field : type.fields) {
    proto::Field& message = *out.add_fields();
    message.set_name(field.name);
    message.set_scalar(static_cast<std::uint32_t>(field.kind));
    message.set_offset_bytes(field.offset_bytes);
    message.set_count(field.count);
    message.set_stride_bytes(field.stride_bytes);
    message.set_bits(field.bits);
    message.set_first_bit(field.first_bit);
  }
}

void to_message(const StreamId& id, const TypeInfo& type, const History& history,
                proto::Create& out) {
  to_message(id, *out.mutable_id());
  to_message(type, *out.mutable_type());
  out.set_depth(history.depth);
  out.set_cycle_ns(to_ns(history.cycle));
}

void to_message(const StreamInfo& info, proto::Stream& out) {
  to_message(info.id, *out.mutable_id());
  to_message(info.type, *out.mutable_type());
  out.set_depth(info.depth);
  out.set_cycle_ns(to_ns(info.cycle));
  out.set_memory_bytes(info.memory_bytes);
  out.set_property_bytes(info.property_bytes);
  out.set_incarnation(info.incarnation);
  out.set_creator_pid(info.creator_pid);
  out.set_oldest(info.oldest);
  out.set_newest(info.newest);
  out.set_newest_time_ns(to_ns(info.newest_time));
  out.set_rate_hz(info.rate_hz);
  out.set_writers(info.writers - info.remote_writers);
  out.set_readers(info.readers - info.remote_readers);
  out.set_remote_writers(info.remote_writers);
  out.set_remote_readers(info.remote_readers);
  out.set_channels(info.channels);
  out.set_crashed_writers(info.crashed_writers);
  out.set_last_crashed_writer(info.last_crashed_writer);
  out.set_crashed_readers(info.crashed_readers);
  out.set_last_crashed_reader(info.last_crashed_reader);
  out.set_state(static_cast<proto::Stream::State>(info.state));
  out.set_age_ns(to_ns(info.age));
  for (const StreamUser& user : info.users) to_message(user, *out.add_users());
}

void to_message(const StreamUser& user, proto::User& out) {
  out.set_pid(user.pid);
  out.set_uid(user.uid.value_or(0));
  out.set_program(user.program);
  out.set_writer(user.role == Role::writer);
  out.set_host(user.host);
  out.set_via(static_cast<proto::Via>(user.via));
}

void to_message(const Error& error, proto::Failure& out) {
  out.set_code(std::string(name_of(error.code)));
  out.set_message(error.message);
}

std::string final_failure(const Error& error) {
  net::Frame frame;
  to_message(error, *frame.mutable_failure());
  return encode_frame(frame);
}

Error other_protocol_version(const ProtocolVersion& ours, const std::string& who,
                             std::uint32_t theirs, const std::string& software) {
  return {Errc::protocol,
          fmt::format("{} speaks version {} of the {} protocol{}, this side (DSSM {}) version {}; "
                      "install the same DSSM on both",
                      who, theirs, ours.name, software.empty() ? "" : " (DSSM " + software + ")",
                      DSSM_VERSION, ours.number)};
}

Result<StreamId> stream_id_untrusted(const proto::StreamId& message) {
  StreamId id{message.name(), message.id(), message.host()};
  DSSM_TRY(id.check());
  return id;
}

Result<TypeInfo> type_untrusted(const proto::Type& message) {
  for (const proto::Field& field : message.fields()) {
    if (field.scalar() > 255) {
      return Error{Errc::protocol, "field '" + field.name() + "' has the unknown kind " +
                                       std::to_string(field.scalar())};
    }
  }
  TypeInfo type = type_info(message);
  DSSM_TRY(type.check());
  return type;
}

StreamUser stream_user_untrusted(const proto::User& message) {
  StreamUser user;
  user.pid = std::max(message.pid(), 0);
  user.program = text_untrusted(message.program(), kMaxProgramBytes);
  user.role = message.writer() ? Role::writer : Role::reader;
  user.via = enum_untrusted(message.via(), StreamVia::connection);
  if (user.via != StreamVia::connection) user.uid = message.uid();
  if (check_host_name(message.host())) user.host = message.host();
  return user;
}

StreamInfo stream_info(const proto::Stream& message) {
  StreamInfo info;
  info.id = {message.id().name(), message.id().id(), message.id().host()};
  info.type = type_info(message.type());
  info.depth = message.depth();
  info.cycle = Duration(message.cycle_ns());
  info.memory_bytes = message.memory_bytes();
  info.property_bytes = message.property_bytes();
  info.incarnation = message.incarnation();
  info.creator_pid = message.creator_pid();
  info.oldest = message.oldest();
  info.newest = message.newest();
  info.newest_time = time_from_ns(message.newest_time_ns());
  info.rate_hz = message.rate_hz();
  info.remote_writers = message.remote_writers();
  info.remote_readers = message.remote_readers();
  info.writers = message.writers() + info.remote_writers;
  info.readers = message.readers() + info.remote_readers;
  info.channels = message.channels();
  info.crashed_writers = message.crashed_writers();
  info.last_crashed_writer = text_untrusted(message.last_crashed_writer(), kMaxCrashedProgramBytes);
  info.crashed_readers = message.crashed_readers();
  info.last_crashed_reader = text_untrusted(message.last_crashed_reader(), kMaxCrashedProgramBytes);
  info.state = enum_untrusted(message.state(), StreamState::no_writer);
  info.age = Duration(message.age_ns());
  for (const proto::User& user : message.users()) {
    info.users.push_back(stream_user_untrusted(user));
    if (info.users.back().host.empty()) info.users.back().host = info.id.host;
  }
  if (message.has_mirror()) info.mirror = mirror_info(message.mirror());
  return info;
}

Error failure(const proto::Failure& message) {
  constexpr Errc kCodes[] = {Errc::invalid_argument, Errc::not_found,   Errc::type_mismatch,
                             Errc::limit_exceeded,   Errc::no_memory,   Errc::no_permission,
                             Errc::no_daemon,        Errc::unavailable, Errc::protocol,
                             Errc::conflict,         Errc::closed,      Errc::clock_out_of_bounds};
  Errc code = Errc::system;
  for (const Errc known : kCodes) {
    if (name_of(known) == message.code()) code = known;
  }
  return Error{code, message.message()};
}

}  // namespace dssm::wire
