// SPDX-License-Identifier: Apache-2.0
//
// The frame that carries a sample, and the one that asks for a sample, written and read by hand: a
// payload must not pass through a protobuf object, and building a Read as one took a twentieth of
// its round trip. proto/network.proto is the specification; tests compare these bytes with stock
// protobuf and tests/golden.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <dssm/sample.hpp>
#include <span>

namespace dssm::wire {

// Field number times 8 plus wire type (0 varint, 1 eight bytes, 2 length-delimited), of Frame ...
inline constexpr std::byte kSerialTag{1 << 3 | 0};
inline constexpr std::byte kSampleTag{2 << 3 | 2};
inline constexpr std::byte kPayloadTag{15 << 3 | 2};
inline constexpr std::array kTornTag = {std::byte{0x88},
                                        std::byte{0x02}};  // 33 << 3 | 0: two bytes

// ... and of Sample.
inline constexpr std::byte kTidTag{1 << 3 | 1};
inline constexpr std::byte kTimeTag{2 << 3 | 1};
inline constexpr std::byte kClockErrorTag{3 << 3 | 1};
inline constexpr std::size_t kFixed64FieldBytes = 9;  // tag and value

// Length, serial, sample, and the payload's tag and length.
inline constexpr std::size_t kMaxSampleHeaderBytes = 64;
inline constexpr std::size_t kTornTrailerBytes = 3;

enum class Trailer : bool { none, torn };  // torn: kTornTrailerBytes follow the payload

// Writes all that comes before the payload's info.payload_bytes; returns how many bytes.
std::size_t encode_sample_header(std::array<std::byte, kMaxSampleHeaderBytes>& out,
                                 std::uint64_t serial, const SampleInfo& info,
                                 Trailer trailer) noexcept;

// The torn trailer: the field `torn`, sent directly after the payload.
std::array<std::byte, kTornTrailerBytes> torn_trailer(bool torn) noexcept;

// What comes before a sample's payload, as encode_sample_header() writes it and stock protobuf does
// in its place. As on the wire; nothing is checked.
struct SampleHead {
  std::uint64_t frame_bytes = 0;  // the frame's length, without its varint
  std::size_t length_bytes = 0;   // of that varint
  std::uint64_t serial = 0;
  std::int64_t tid = 0, time_ns = 0;
  std::uint64_t clock_error_ns = 0;
  std::uint64_t payload_bytes = 0;
  std::size_t bytes = 0;          // up to the payload's first byte
  std::size_t trailer_bytes = 0;  // what follows the payload within the frame
};

enum class HeadStatus : unsigned char {
  sample,      // it is a sample in our order of fields: all of `head` is set
  other,       // another frame, or a sample in another order: frame_bytes and length_bytes are set
  incomplete,  // more input is needed to decide; never with kMaxSampleHeaderBytes or more
  no_frame,    // it does not begin with a length
};

// Reads the beginning of a frame.
HeadStatus read_sample_head_untrusted(std::span<const std::byte> input, SampleHead& head) noexcept;

// Which sample a Read asks for. A value.
struct ReadRequest {
  enum class Which : std::uint8_t { tid, time, newest, newer_than };  // as in net::Read
  Which which = Which::newest;
  std::int64_t value = 0;  // a tid, or nanoseconds
};

inline constexpr std::size_t kMaxReadRequestBytes = 32;

// Writes the frame, with its length; returns how many bytes.
std::size_t encode_read_request(std::array<std::byte, kMaxReadRequestBytes>& out,
                                std::uint64_t serial, const ReadRequest& request) noexcept;

}  // namespace dssm::wire
