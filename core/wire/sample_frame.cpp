// SPDX-License-Identifier: Apache-2.0
#include "core/wire/sample_frame.hpp"

#include <algorithm>
#include <bit>
#include <cstring>

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
                                              Trailer trailer) noexcept {
  // All three stamps are written, also those that are 0 and that protobuf would leave out: so all
  // headers of samples of one length have one length.
  const std::size_t sample_bytes = 3 * kFixed64FieldBytes;
  std::uint64_t frame_bytes =
      2 + sample_bytes + 1 + varint_bytes(info.payload_bytes) + info.payload_bytes;
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
  at = write_varint(at, info.payload_bytes);
  return static_cast<std::size_t>(at - out.data());
}

std::array<std::byte, kTornTrailerBytes> torn_trailer(bool torn) noexcept {
  return {kTornTag[0], kTornTag[1], static_cast<std::byte>(torn)};
}

namespace {

// The fields of Sample, which fill [at, end).
bool read_stamps(const std::byte* at, const std::byte* end, SampleHead& head) noexcept {
  for (; at != end; at += kFixed64FieldBytes) {
    if (*at == kTidTag) {
      std::memcpy(&head.tid, at + 1, sizeof head.tid);
    } else if (*at == kTimeTag) {
      std::memcpy(&head.time_ns, at + 1, sizeof head.time_ns);
    } else if (*at == kClockErrorTag) {
      std::memcpy(&head.clock_error_ns, at + 1, sizeof head.clock_error_ns);
    } else {
      return false;
    }
  }
  return true;
}

}  // namespace

// Our order of fields is: serial or nothing, sample, payload, and at most `torn` after it. Within
// the sample any order of the three stamps is accepted, and any of them may be missing (protobuf
// leaves out zeros). Protobuf's own parser decodes everything else.
[[gnu::hot]] HeadStatus read_sample_head_untrusted(std::span<const std::byte> input,
                                                   SampleHead& head) noexcept {
  head = {};
  const std::byte* at = input.data();
  const std::byte* end = at + input.size();
  switch (read_varint(at, end, kMaxLengthBytes, head.frame_bytes)) {
    case VarintStatus::cut:
      return HeadStatus::incomplete;
    case VarintStatus::too_long:
      return HeadStatus::no_frame;
    case VarintStatus::ok:
      break;
  }
  head.length_bytes = static_cast<std::size_t>(at - input.data());
  // The status when the bytes end here: the frame is there as a whole, or more of it is to come.
  HeadStatus at_the_end = HeadStatus::incomplete;
  const auto bytes_there = static_cast<std::uint64_t>(end - at);
  if (bytes_there >= head.frame_bytes) {
    end = at + head.frame_bytes;
    at_the_end = HeadStatus::other;
  }
  const auto status_of = [&](VarintStatus status) {
    return status == VarintStatus::cut ? at_the_end : HeadStatus::other;
  };

  if (at == end) return at_the_end;
  if (*at == kSerialTag) {
    const VarintStatus status = read_varint(++at, end, kMaxVarintBytes, head.serial);
    if (status != VarintStatus::ok) return status_of(status);
    if (at == end) return at_the_end;
  }
  if (*at != kSampleTag) return HeadStatus::other;
  if (++at == end) return at_the_end;
  const auto sample_bytes = std::to_integer<std::size_t>(*at++);
  if (sample_bytes > 3 * kFixed64FieldBytes || sample_bytes % kFixed64FieldBytes != 0) {
    return HeadStatus::other;
  }
  if (static_cast<std::size_t>(end - at) <= sample_bytes) return at_the_end;
  if (!read_stamps(at, at + sample_bytes, head)) return HeadStatus::other;
  at += sample_bytes;
  if (*at != kPayloadTag) return HeadStatus::other;
  const VarintStatus status = read_varint(++at, end, kMaxLengthBytes, head.payload_bytes);
  if (status != VarintStatus::ok) return status_of(status);

  head.bytes = static_cast<std::size_t>(at - input.data());
  const std::uint64_t before_payload = head.bytes - head.length_bytes;
  if (before_payload > head.frame_bytes || head.payload_bytes > head.frame_bytes - before_payload) {
    return HeadStatus::other;  // the payload ends after its frame: protobuf will refuse it
  }
  head.trailer_bytes =
      static_cast<std::size_t>(head.frame_bytes - before_payload - head.payload_bytes);
  const bool is_ours = head.trailer_bytes == 0 || head.trailer_bytes == kTornTrailerBytes;
  return is_ours ? HeadStatus::sample : HeadStatus::other;
}

namespace {

constexpr std::byte kReadTag{9 << 3 | 2};  // of Frame
constexpr std::byte kReadTidTag{1 << 3 | 0}, kReadTimeTag{2 << 3 | 1}, kReadNewestTag{3 << 3 | 0},
    kReadNewerThanTag{4 << 3 | 0};  // of Read

}  // namespace

std::size_t encode_read_request(std::array<std::byte, kMaxReadRequestBytes>& out,
                                std::uint64_t serial, const ReadRequest& request) noexcept {
  std::array<std::byte, 1 + kMaxVarintBytes> read;
  std::byte* end = read.data();
  switch (request.which) {
    case ReadRequest::Which::tid:
      *end++ = kReadTidTag;
      end = write_varint(end, static_cast<std::uint64_t>(request.value));
      break;
    case ReadRequest::Which::time:
      *end++ = kReadTimeTag;
      std::memcpy(end, &request.value, sizeof request.value);
      end += sizeof request.value;
      break;
    case ReadRequest::Which::newest:
      *end++ = kReadNewestTag;
      *end++ = std::byte{1};
      break;
    case ReadRequest::Which::newer_than:
      *end++ = kReadNewerThanTag;
      end = write_varint(end, static_cast<std::uint64_t>(request.value));
      break;
  }
  const auto read_bytes = static_cast<std::size_t>(end - read.data());
  std::byte* at = write_varint(out.data(), 1 + varint_bytes(serial) + 2 + read_bytes);
  *at++ = kSerialTag;
  at = write_varint(at, serial);
  *at++ = kReadTag;
  *at++ = static_cast<std::byte>(read_bytes);
  std::memcpy(at, read.data(), read_bytes);
  return static_cast<std::size_t>(at - out.data()) + read_bytes;
}

}  // namespace dssm::wire
