// SPDX-License-Identifier: Apache-2.0
//
// Reading by hand what encode_sample_header() writes, and what stock protobuf writes in its place:
// the part of a sample frame that comes before its payload.
#pragma once

#include <cstddef>
#include <cstdint>
#include <span>

namespace dssm::wire {

// As on the wire; nothing is checked.
struct SampleHead {
  std::uint64_t frame_bytes = 0;  // the frame's length, without the varint that says it
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
  no_frame,    // what should be the frame's length is none
};

// Looks at the beginning of a frame.
HeadStatus read_sample_head_untrusted(std::span<const std::byte> input, SampleHead& head) noexcept;

}  // namespace dssm::wire
