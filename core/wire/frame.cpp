// SPDX-License-Identifier: Apache-2.0
#include "core/wire/frame.hpp"

#include <fmt/format.h>
#include <google/protobuf/io/coded_stream.h>
#include <google/protobuf/message_lite.h>

#include <algorithm>
#include <cstring>

#include "core/wire/varint.hpp"

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
  constexpr std::size_t kMinSpace = 4096;
  if (begin_ == end_) begin_ = end_ = 0;
  if (buffer_.size() - end_ < kMinSpace) {
    if (begin_ > 0) {
      std::memmove(buffer_.data(), buffer_.data() + begin_, end_ - begin_);
      end_ -= begin_;
      begin_ = 0;
    }
    if (buffer_.size() - end_ < kMinSpace)
      buffer_.resize(std::max(2 * buffer_.size(), end_ + kMinSpace));
  }
  return std::span(buffer_).subspan(end_);
}

Result<std::optional<std::span<const std::byte>>> FrameBuffer::next() {
  if (begin_ == end_ && buffer_.size() > kKeptBytes) {
    buffer_ = std::vector<std::byte>();  // a rare large frame does not keep its memory
    begin_ = end_ = 0;
  }
  const std::span<const std::byte> input = std::span(buffer_).subspan(begin_, end_ - begin_);
  const std::byte* at = input.data();
  const std::byte* const end = at + input.size();
  std::uint64_t length = 0;
  switch (read_varint(at, end, kMaxLengthBytes, length)) {
    case VarintStatus::ok:
      break;
    case VarintStatus::cut:
      return std::optional<std::span<const std::byte>>();
    case VarintStatus::too_long:
      return Error{Errc::protocol, "the input is not a varint-delimited frame"};
  }
  if (length > max_frame_bytes_) {
    return Error{Errc::protocol, fmt::format("a frame of {} bytes is longer than the limit of {}",
                                             length, max_frame_bytes_)};
  }
  if (static_cast<std::uint64_t>(end - at) < length) {
    return std::optional<std::span<const std::byte>>();
  }
  const std::span<const std::byte> frame(at, length);
  begin_ = static_cast<std::size_t>(frame.data() - buffer_.data()) + length;
  return std::optional(frame);
}

}  // namespace dssm::wire
