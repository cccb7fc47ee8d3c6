// SPDX-License-Identifier: Apache-2.0
#include "core/wire/frame.hpp"

#include <google/protobuf/io/coded_stream.h>
#include <google/protobuf/message_lite.h>

#include <algorithm>
#include <cstring>

namespace dssm::wire {

std::string encode_frame(const google::protobuf::MessageLite& message) {
  const std::size_t bytes = message.ByteSizeLong();
  std::string frame;
  frame.resize(bytes + 10);
  auto* start = reinterpret_cast<std::uint8_t*>(frame.data());
  auto* body = google::protobuf::io::CodedOutputStream::WriteVarint64ToArray(bytes, start);
  std::uint8_t* end = message.SerializeWithCachedSizesToArray(body);
  frame.resize(static_cast<std::size_t>(end - start));
  return frame;
}

std::span<std::byte> FrameBuffer::space() {
  constexpr std::size_t kRoom = 4096, kKeptBytes = 64 << 10;
  if (begin_ == end_) {
    begin_ = end_ = 0;
    if (buffer_.size() > kKeptBytes)
      buffer_ = std::vector<std::byte>();  // a rare large frame does not cost memory for ever
  }
  if (buffer_.size() - end_ < kRoom) {
    if (begin_ > 0) {
      std::memmove(buffer_.data(), buffer_.data() + begin_, end_ - begin_);
      end_ -= begin_;
      begin_ = 0;
    }
    if (buffer_.size() - end_ < kRoom) buffer_.resize(std::max(2 * buffer_.size(), end_ + kRoom));
  }
  return std::span(buffer_).subspan(end_);
}

Result<std::optional<std::span<const std::byte>>> FrameBuffer::next() {
  std::uint64_t length = 0;
  std::size_t at = begin_;
  for (int shift = 0;; shift += 7) {
    if (shift > 28) {  // five bytes hold more than any frame that we take
      return Error{Errc::protocol, "the input is no varint-delimited frame"};
    }
    if (at == end_) return std::optional<std::span<const std::byte>>();
    const auto byte = std::to_integer<std::uint64_t>(buffer_[at++]);
    length |= (byte & 0x7f) << shift;
    if (!(byte & 0x80)) break;
  }
  if (length > max_frame_bytes_) {
    return Error{Errc::protocol, "a frame of " + std::to_string(length) +
                                     " bytes is longer than the " +
                                     std::to_string(max_frame_bytes_) + " that are taken"};
  }
  if (end_ - at < length) return std::optional<std::span<const std::byte>>();
  const auto frame = std::span<const std::byte>(buffer_).subspan(at, length);
  begin_ = at + length;
  return std::optional(frame);
}

}  // namespace dssm::wire
