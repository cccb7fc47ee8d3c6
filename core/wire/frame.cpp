// SPDX-License-Identifier: Apache-2.0
#include "core/wire/frame.hpp"

#include <fmt/format.h>
#include <google/protobuf/io/coded_stream.h>
#include <google/protobuf/message_lite.h>

#include <algorithm>
#include <cstring>
#include <new>

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
  if (capacity_ - end_ < kMinSpace) {
    if (begin_ > 0) {
      std::memmove(buffer_.get(), buffer_.get() + begin_, end_ - begin_);
      end_ -= begin_;
      begin_ = 0;
    }
    if (capacity_ - end_ < kMinSpace) {
      const std::size_t larger = std::max(2 * capacity_, end_ + kMinSpace);
      auto* moved = static_cast<std::byte*>(std::realloc(buffer_.get(), larger));
      if (!moved) throw std::bad_alloc();
      static_cast<void>(buffer_.release());
      buffer_.reset(moved);
      capacity_ = larger;
    }
  }
  return {buffer_.get() + end_, capacity_ - end_};
}

Result<std::optional<std::span<const std::byte>>> FrameBuffer::next() {
  if (begin_ == end_ && capacity_ > kKeptBytes) {
    buffer_.reset();  // a rare large frame does not keep its memory
    capacity_ = begin_ = end_ = 0;
  }
  const std::span<const std::byte> input(buffer_.get() + begin_, end_ - begin_);
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
  begin_ = static_cast<std::size_t>(frame.data() - buffer_.get()) + length;
  return std::optional(frame);
}

}  // namespace dssm::wire
