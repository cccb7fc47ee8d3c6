// SPDX-License-Identifier: Apache-2.0
//
// Cuts what arrives over a network connection into frames. A sample's payload is received where the
// delegate wants it: a large one directly by the kernel (the space that spaces() returns is the
// slot itself), small ones that arrive many at a time with one copy out of the input buffer. Frames
// whose fields come in another order than ours are collected and parsed by protobuf: slower, same
// result.
//
//   use     spaces() -> Transport::receive() -> commit() ; again
//   trust   nothing that arrives is trusted: lengths are checked against the limits, and memory
//           grows with what has arrived, not with what was announced
//   memory  a decoder that waits for the next frame owns no buffer: the input buffer belongs to the
//           thread, and a decoder uses it from spaces() to commit(). A hundred idle channels cost a
//           hundred small objects, and a busy one finds the buffer in the processor's cache.
#pragma once

#include <sys/uio.h>

#include <array>
#include <cstddef>
#include <cstdint>
#include <dssm/result.hpp>
#include <dssm/sample.hpp>
#include <memory>
#include <span>
#include <vector>

#include "core/wire/sample_frame.hpp"
#include "network.pb.h"

namespace dssm::wire {

// A sample frame's fields before its payload.
struct IncomingSample {
  std::uint64_t serial = 0;
  SampleInfo info;  // tid >= 0, clock_error >= 0, payload_bytes; the receiver checks the rest
};

// Gets what the decoder has decoded; called from commit(). An error ends the decoding: the
// connection is to be closed.
class FrameDelegate {
 public:
  // A sample begins. `out` is set to where its payload is stored, or nullptr to drop it.
  // The place stays valid until on_sample_end(), or as long as the decoder is used.
  virtual Result<void> on_sample_begin(const IncomingSample& sample, std::byte*& out) = 0;
  // Its payload is complete. torn: the sender marked it as void.
  virtual Result<void> on_sample_end(const IncomingSample& sample, bool torn) = 0;
  // Any other frame. May be moved from.
  virtual Result<void> on_frame(net::Frame& frame) = 0;

 protected:
  ~FrameDelegate() = default;
};

struct DecoderCounters {
  std::uint64_t samples = 0;
  std::uint64_t copied_payload_bytes = 0;  // out of the input buffer
  std::uint64_t direct_payload_bytes = 0;  // received where they belong
};

class FrameDecoder {
 public:
  // Of a frame that is collected: many peers may send long ones in the same turn.
  static constexpr std::size_t kCollectedPerReceive = 64U << 10;

  // max_frame_bytes: of frames without a payload, before set_payload_bytes() also of all.
  FrameDecoder(FrameDelegate& delegate, std::size_t max_frame_bytes);
  FrameDecoder(const FrameDecoder&) = delete;
  FrameDecoder& operator=(const FrameDecoder&) = delete;
  ~FrameDecoder();

  // Frames without a payload have to be requests: much shorter ones are taken
  // (check_request_size_untrusted()).
  void take_requests_only() noexcept { requests_only_ = true; }

  // From now on samples have at most so many bytes; a longer sample is an error.
  // 0 (at first): samples are refused.
  void set_payload_bytes(std::size_t payload_bytes) noexcept;

  // Where to receive: the rest of a payload that is under way (may be missing), then the input
  // buffer. At least 4 KiB in all. Valid until the next call of any member, and until another
  // decoder's spaces() in the same thread.
  std::span<const iovec> spaces();

  // `bytes` were received into spaces(), in the same thread. Calls the delegate for all that is
  // complete now.
  //   fails  protocol (no frame, too long ...), and what the delegate returned;
  //          the decoder is not usable afterwards
  Result<void> commit(std::size_t bytes);

  // Called by the delegate: commit() shall return now, though more may be buffered. The next
  // commit(), which may be one of 0 bytes, continues. Until then nothing is to be received.
  //   in on_sample_begin()  there is no place for this sample now: `out` is not used, the sample
  //                         stays in the input buffer, and on_sample_begin() comes again for it
  //   in the others         what they were called with is handled; commit() returns after it
  void hold() noexcept { held_ = true; }

  // Whether a payload has begun that is not complete: the place that the delegate set is in use.
  bool in_payload() const noexcept { return stage_ == Stage::payload && place_ != nullptr; }

  // The rest of the sample under way, between on_sample_begin() and on_sample_end(), goes to
  // `place`: what has arrived of its payload is copied there, and its old place is free.
  void move_payload(std::byte* place) noexcept;

  // Whether nothing is buffered: the last commit() ended at the end of a frame.
  bool at_frame_end() const noexcept;

  // Memory that the frame under way takes, when it is not a sample in our order of fields.
  std::size_t collected_bytes() const noexcept { return whole_.capacity(); }

  const DecoderCounters& counters() const noexcept { return counters_; }

 private:
  using Bytes = std::span<const std::byte>;
  struct InputBuffer;
  static std::unique_ptr<InputBuffer>& thread_input();

  // What the next byte belongs to.
  enum class Stage : unsigned char {
    head,     // a frame's length and, if it is a sample, all that comes before the payload
    payload,  // payload_left_ bytes of a sample's payload
    trailer,  // trailer_left_ bytes after it
    whole,    // whole_left_ bytes of a frame that is collected
  };

  // Each takes from the front of `input` what it can use now.
  Result<void> decode(Bytes& input);
  Result<void> take_head(Bytes& input);
  Result<void> take_payload(Bytes& input);
  Result<void> take_trailer(Bytes& input);
  Result<void> take_whole(Bytes& input);

  Result<void> begin_whole(Bytes& input, std::size_t length_bytes, std::size_t frame_bytes);
  Result<void> begin_sample(std::byte*& place);
  Result<void> end_sample(bool torn);
  Result<void> parse_whole(Bytes message);
  Result<void> hand_out_slowly(net::Frame& frame, std::size_t frame_bytes);
  Result<void> check_payload_bytes(std::uint64_t payload_bytes) const;
  bool has_more(Bytes input) const noexcept;
  std::size_t longest_frame_bytes() const noexcept;

  FrameDelegate& delegate_;
  std::size_t max_frame_bytes_;
  bool requests_only_ = false;
  std::size_t payload_bytes_ = 0;
  DecoderCounters counters_;
  std::array<iovec, 2> spaces_{};

  Stage stage_ = Stage::head;
  bool held_ = false;     // the delegate called hold()
  bool refused_ = false;  // it did so in on_sample_begin(): the sample is still in the input
  std::size_t head_bytes_ = 0;
  std::array<std::byte, kMaxSampleHeaderBytes> head_{};  // a head that is not complete
  IncomingSample sample_;                                // the one under way
  std::byte* place_ = nullptr;                           // where its next byte goes; null: nowhere
  std::size_t payload_left_ = 0;
  std::size_t trailer_bytes_ = 0, trailer_left_ = 0;
  std::array<std::byte, kTornTrailerBytes> trailer_{};
  std::vector<std::byte> whole_;
  std::size_t whole_left_ = 0;
  std::unique_ptr<InputBuffer> kept_input_;  // not decoded yet, because of hold()
};

}  // namespace dssm::wire
