// SPDX-License-Identifier: Apache-2.0
//
// Varint-delimited protobuf frames in a byte stream: encoding them, for both protocols, and cutting
// whole frames out of what arrives at the local socket. The network protocol's FrameDecoder puts
// payloads where they belong, without a buffer of its own.
#pragma once

#include <cstddef>
#include <cstdint>
#include <cstdlib>
#include <dssm/result.hpp>
#include <memory>
#include <optional>
#include <span>
#include <string>

namespace google::protobuf {
class MessageLite;
}

namespace dssm::wire {

// One message with its length in front, ready to be sent.
std::string encode_frame(const google::protobuf::MessageLite& message);

// Collects bytes as they arrive and returns whole frames. A value; one per connection.
class FrameBuffer {
 public:
  // max_frame_bytes: a longer frame is an error, found from its length alone, before memory is
  // taken for it.
  explicit FrameBuffer(std::size_t max_frame_bytes) : max_frame_bytes_(max_frame_bytes) {}

  // Space for at least 4 KiB of input; fill from its start, then commit() what was filled.
  std::span<std::byte> space();
  void commit(std::size_t bytes) noexcept { end_ += bytes; }

  // Memory that it takes. More than kKeptBytes only until next() finds nothing left.
  static constexpr std::size_t kKeptBytes = 64U << 10;
  std::size_t capacity() const noexcept { return capacity_; }

  // The next whole frame's message, without its length; nullopt when more input is needed. The view
  // holds until the next call of any member. Fails with `protocol` on a length that is too large or
  // not a varint; nothing after it can be read.
  Result<std::optional<std::span<const std::byte>>> next();

 private:
  // From malloc(): a large one grows without a copy, and what is not filled takes no memory.
  struct Free {
    void operator()(std::byte* bytes) const noexcept { std::free(bytes); }
  };

  std::size_t max_frame_bytes_;
  std::unique_ptr<std::byte, Free> buffer_;
  std::size_t capacity_ = 0;
  std::size_t begin_ = 0, end_ = 0;  // buffer_[begin_, end_) is input not yet returned
};

}  // namespace dssm::wire
