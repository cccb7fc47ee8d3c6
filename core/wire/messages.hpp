// SPDX-License-Identifier: Apache-2.0
//
// Converts between the messages of proto/common.proto and the public types, for both protocols. The
// functions named *_untrusted check every value.
#pragma once

#include <dssm/result.hpp>
#include <dssm/stream.hpp>
#include <string>
#include <string_view>

#include "catalog.pb.h"
#include "common.pb.h"

namespace dssm::wire {

// A property is copied whole within one turn of dssmd's loop. What is longer is a sample.
inline constexpr std::size_t kMaxPropertyBytes = 1U << 20;
inline constexpr std::size_t kMaxProgramBytes = 127;
inline constexpr std::size_t kMaxCrashedProgramBytes = 150;  // a program and its pid
inline constexpr std::size_t kMaxSentenceBytes = 511;        // for people, of another host

// The value of an enum that came in a message; when it is beyond `last`, the first one, which means
// that nothing is known.
template <class Enum>
Enum enum_untrusted(std::int64_t value, Enum last) noexcept {
  return value >= 0 && value <= static_cast<std::int64_t>(last) ? static_cast<Enum>(value) : Enum{};
}

// `text` with '?' for control characters, and cut off after `max_bytes` or where it is not UTF-8.
std::string text_untrusted(const std::string& text, std::size_t max_bytes);

// Public types to messages.
void to_message(const StreamId& id, proto::StreamId& out);
void to_message(const TypeInfo& type, proto::Type& out);
// Without its mirror, which Mirror::describe() sets.
void to_message(const StreamInfo& info, proto::Stream& out);
void to_message(const StreamUser& user, proto::User& out);
void to_message(const StreamId& id, const TypeInfo& type, const History& history,
                proto::Create& out);
void to_message(const Error& error, proto::Failure& out);

// The frame that a side sends before it closes the connection: the same bytes in both protocols.
std::string final_failure(const Error& error);

// A protocol's name ("local", "network") and the version that this side speaks.
struct ProtocolVersion {
  std::string_view name;
  std::uint32_t number = 0;
};

// Why this side cannot communicate with `who`, which has the version `theirs`.
//   software  "0.3.0"; empty: not known
Error other_protocol_version(const ProtocolVersion& ours, const std::string& who,
                             std::uint32_t theirs, const std::string& software = {});

// Messages to public types.
Result<StreamId> stream_id_untrusted(const proto::StreamId& message);
Result<TypeInfo> type_untrusted(const proto::Type& message);
StreamInfo stream_info(const proto::Stream& message);
StreamUser stream_user_untrusted(const proto::User& message);  // host: as it is there, or empty
Error failure(const proto::Failure& message);

}  // namespace dssm::wire
