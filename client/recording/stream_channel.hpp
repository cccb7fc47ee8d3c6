// SPDX-License-Identifier: Apache-2.0
//
// How a stream and its samples are in an MCAP file; docs/recording.md "Format" has the same with
// examples. A stream (of one incarnation) is a channel, whose metadata has all that RecordedStream
// has but the property. A sample is a message:
//
//   log_time      = publish_time = its time; 0 for a time before 1970
//   sequence      the low 32 bits of its tid
//   data          00 01 00 00 (CDR, little endian), then
//                 - with fields: the payload as in memory, with zeros up to the payload_bytes of
//                   its type
//                 - without: its length (4 bytes) and the payload, a sequence of uint8
//                 then the trailer: what a message has no place for. MCAP tools decode by the
//                 schema and ignore it. Each message has all of its own, so that tools may
//                 filter, sort and merge them.
//
// Trailer: a byte of flags (TrailerFlag), then for each flag, from the lowest on, a number as
// varint (LEB128). No trailer is the same as flags 0.
#pragma once

#include <cstdint>
#include <dssm/recording.hpp>
#include <optional>
#include <string>

#include "client/recording/records.hpp"

namespace dssm::recording {

enum TrailerFlag : unsigned {
  has_clock_error = 1,    // info.clock_error [ns]; without: unknown
  has_clock_bound = 2,    // the bound against the recording PC's clock [ns]; without: unknown
  has_tid_high = 4,       // the high 32 bits of the tid; without: 0
  has_payload_bytes = 8,  // of a sample that is shorter than its type's payload_bytes
  has_early_time = 16,    // time before 1970 [ns, two's complement]; without: log_time
};
inline constexpr std::size_t kMaxTrailerBytes = 1 + 5 * 10;

// The data of a message besides payload and trailer.
inline constexpr std::size_t kCdrHeadBytes = 4;
inline constexpr std::uint32_t kCdrHead = 0x0100;  // 00 01 00 00: little endian
inline constexpr std::size_t kSequenceHeadBytes = 4;

// "name[:id]@host".
std::string topic_of(const StreamId& id);

// The metadata of a stream's channel, without ids.
Channel channel_of(const RecordedStream& stream);

// Gives such a channel another description of its type.
void set_type(Channel& channel, const TypeInfo& type);

// The stream of a channel that channel_of() made; its property is empty. nullopt: another program
// made the channel.
//   fails  protocol
Result<std::optional<RecordedStream>> stream_of(const Channel& channel);

// What a message says about its sample.
struct MessageSample {
  SampleInfo info;
  Duration clock_error = kUnknownClockError;
  std::uint64_t payload_offset = 0;  // in the message's data
};

// Whether the payload is a sequence with its length before it.
inline bool is_sequence(const TypeInfo& type) noexcept { return type.fields.empty(); }

// Appends the message to `out`.
void encode_message(Buffer& out, std::uint16_t channel, const TypeInfo& type,
                    const SampleInfo& info, Duration clock_error,
                    std::span<const std::byte> payload);

inline std::uint64_t log_time_of(Time time) noexcept {
  return to_ns(time) < 0 ? 0 : static_cast<std::uint64_t>(to_ns(time));
}

// The most that encode_message() appends.
inline std::size_t message_bytes(const TypeInfo& type, std::uint64_t payload_bytes) noexcept {
  return kRecordHeadBytes + kMessageHeadBytes + kCdrHeadBytes +
         (is_sequence(type) ? kSequenceHeadBytes + payload_bytes : type.payload_bytes) +
         kMaxTrailerBytes;
}

// `data` is the message's, of a stream of that type. nullopt: it is not one of encode_message().
std::optional<MessageSample> decode_message(const TypeInfo& type, std::uint32_t sequence,
                                            std::uint64_t log_time,
                                            std::span<const std::byte> data) noexcept;

}  // namespace dssm::recording
