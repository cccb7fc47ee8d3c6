// SPDX-License-Identifier: Apache-2.0
//
// Our order of fields is: serial or nothing, sample, payload, and at most `torn` after it. Within
// the sample any order of the three stamps is accepted, and any of them may be missing (protobuf
// leaves out zeros). Protobuf's own parser decodes everything else.
#include "core/wire/sample_head.hpp"

#include <algorithm>
#include <cstring>

#include "core/wire/sample_frame.hpp"
#include "core/wire/sample_tags.hpp"
#include "core/wire/varint.hpp"

namespace dssm::wire {
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
  // What to say when the bytes end here: the frame is there as a whole, or more of it is to come.
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
    return HeadStatus::other;  // the payload ends after its frame: protobuf will say that it is
                               // none
  }
  head.trailer_bytes =
      static_cast<std::size_t>(head.frame_bytes - before_payload - head.payload_bytes);
  const bool is_ours = head.trailer_bytes == 0 || head.trailer_bytes == kTornTrailerBytes;
  return is_ours ? HeadStatus::sample : HeadStatus::other;
}

}  // namespace dssm::wire
