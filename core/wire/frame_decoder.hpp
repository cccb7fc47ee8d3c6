// SPDX-License-Identifier: Apache-2.0
//
// Cuts what arrives over a network connection into frames. A sample's payload goes where the
// receiver wants it: straight from the kernel for large ones (the space that space() gives is the
// slot itself), with one copy out of the input buffer for those that arrive many at a time. Frames
// whose fields come in another order than ours are collected and parsed by protobuf: slower, same
// result.
//
//   use     spaces() -> Transport::receive() -> commit() ; again
//   trust   nothing that arrives is believed: lengths are checked against the limits before memory
//           is taken for them
#pragma once

#include <sys/uio.h>

#include <array>
#include <cstddef>
#include <cstdint>
#include <dssm/result.hpp>
#include <dssm/sample.hpp>
#include <span>
#include <vector>

#include "network.pb.h"

namespace dssm::wire {

// A sample frame's fields before its payload.
struct IncomingSample {
  std::uint64_t serial = 0;
  SampleInfo info;  // clock_error >= 0; tid as it came: the receiver checks it
  std::size_t payload_bytes = 0;
};

// What the decoder hands out; called from commit(). An error ends the decoding: the connection is
// to be closed.
class FrameSink {
 public:
  // A sample begins. `out` is set to where its payload_bytes are to go, or nullptr to throw them
  // away. The place stays valid until on_sample_end() or the sink is told on_sample_cut().
  virtual Result<void> on_sample_begin(const IncomingSample& sample, std::byte*& out) = 0;
  // Its payload is complete. torn: the sender says that it is void.
  virtual Result<void> on_sample_end(const IncomingSample& sample, bool torn) = 0;
  // Any other frame. May be moved from.
  virtual Result<void> on_frame(net::Frame& frame) = 0;

 protected:
  ~FrameSink() = default;
};

struct DecoderCounters {
  std::uint64_t samples = 0;
  std::uint64_t copied_payload_bytes = 0;  // out of the input buffer
  std::uint64_t direct_payload_bytes = 0;  // received where they belong
  std::uint64_t slow_frames = 0;           // sample frames in another order of fields
};

class FrameDecoder {
 public:
  // max_frame_bytes: of frames without a payload, before set_payload_bytes() also of all.
  FrameDecoder(FrameSink& sink, std::size_t max_frame_bytes);

  // From now on samples have exactly so many bytes; a frame that says otherwise is an error.
  // 0 (at first): samples are refused.
  void set_payload_bytes(std::size_t payload_bytes) noexcept;

  // Where to receive: the rest of a payload that is under way (may be missing), then the input
  // buffer. At least 4 KiB in all. Valid until the next call of any member.
  std::span<const iovec> spaces();

  // `bytes` were received into spaces(). Calls the sink for all that is complete now.
  //   fails  protocol (no frame, too long, wrong payload size ...), and what the sink returned;
  //          the decoder is not usable afterwards
  Result<void> commit(std::size_t bytes);

  // From within the sink: commit() shall return now, though more may be buffered. The next commit(),
  // which may be one of 0 bytes, goes on. Until then nothing is to be received.
  //   in on_sample_begin()  there is no place for this sample now: `out` is not used, the sample stays
  //                         in the input buffer, and on_sample_begin() comes again for it
  //   in the others         what was handed out is taken; commit() returns after it
  void hold() noexcept;

  // Whether a payload has begun that is not complete: the place that the sink gave is in use.
  bool in_payload() const noexcept;

  // Whether nothing is buffered: the last commit() ended at the end of a frame.
  bool at_frame_end() const noexcept;

  const DecoderCounters& counters() const noexcept { return counters_; }

 private:
  // The implementer chooses the state.
  FrameSink& sink_;
  std::size_t max_frame_bytes_;
  std::size_t payload_bytes_ = 0;
  DecoderCounters counters_;
};

}  // namespace dssm::wire
