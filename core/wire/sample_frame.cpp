// SPDX-License-Identifier: Apache-2.0
#include "core/wire/sample_frame.hpp"

#include <bit>
#include <cstring>

#include "core/wire/sample_tags.hpp"
#include "core/wire/varint.hpp"

namespace dssm::wire {
namespace {

static_assert(std::endian::native == std::endian::little, "fixed64 is copied as it stands");

std::byte* write_fixed64(std::byte* out, std::byte tag, std::int64_t value) noexcept {
  *out++ = tag;
  std::memcpy(out, &value, sizeof value);
  return out + sizeof value;
}

}  // namespace

[[gnu::hot]] std::size_t encode_sample_header(std::array<std::byte, kMaxSampleHeaderBytes>& out,
                                              std::uint64_t serial, const SampleInfo& info,
                                              std::size_t payload_bytes, Trailer trailer) noexcept {
  // All three stamps are written, also those that are 0 and that protobuf would leave out: so all
  // headers of a stream have one length.
  const std::size_t sample_bytes = 3 * kFixed64FieldBytes;
  std::uint64_t frame_bytes = 2 + sample_bytes + 1 + varint_bytes(payload_bytes) + payload_bytes;
  if (serial != 0) frame_bytes += 1 + varint_bytes(serial);
  if (trailer == Trailer::torn) frame_bytes += kTornTrailerBytes;

  std::byte* at = write_varint(out.data(), frame_bytes);
  if (serial != 0) {
    *at++ = kSerialTag;
    at = write_varint(at, serial);
  }
  *at++ = kSampleTag;
  *at++ = static_cast<std::byte>(sample_bytes);
  at = write_fixed64(at, kTidTag, info.tid);
  at = write_fixed64(at, kTimeTag, to_ns(info.time));
  at = write_fixed64(at, kClockErrorTag, to_ns(info.clock_error));
  *at++ = kPayloadTag;
  at = write_varint(at, payload_bytes);
  return static_cast<std::size_t>(at - out.data());
}

std::array<std::byte, kTornTrailerBytes> torn_trailer(bool torn) noexcept {
  return {kTornTag[0], kTornTag[1], static_cast<std::byte>(torn)};
}

}  // namespace dssm::wire
