// SPDX-License-Identifier: Apache-2.0
#include "client/src/read_request.hpp"

#include <bit>
#include <cstring>

#include "core/wire/varint.hpp"

namespace dssm::detail {
namespace {

static_assert(std::endian::native == std::endian::little, "fixed64 is copied as it stands");

// Field number times 8 plus wire type (0 varint, 1 eight bytes, 2 length-delimited).
constexpr std::byte kSerialTag{1 << 3 | 0}, kReadTag{9 << 3 | 2};  // of Frame
constexpr std::byte kTidTag{1 << 3 | 0}, kTimeTag{2 << 3 | 1}, kNewestTag{3 << 3 | 0},
    kNewerThanTag{4 << 3 | 0};  // of Read

}  // namespace

std::size_t encode_read_request(std::array<std::byte, kMaxReadRequestBytes>& out,
                                std::uint64_t serial, const ReadRequest& request) noexcept {
  std::array<std::byte, 1 + wire::kMaxVarintBytes> read;
  std::byte* end = read.data();
  switch (request.which) {
    case ReadRequest::Which::tid:
      *end++ = kTidTag;
      end = wire::write_varint(end, static_cast<std::uint64_t>(request.value));
      break;
    case ReadRequest::Which::time:
      *end++ = kTimeTag;
      std::memcpy(end, &request.value, sizeof request.value);
      end += sizeof request.value;
      break;
    case ReadRequest::Which::newest:
      *end++ = kNewestTag;
      *end++ = std::byte{1};
      break;
    case ReadRequest::Which::newer_than:
      *end++ = kNewerThanTag;
      end = wire::write_varint(end, static_cast<std::uint64_t>(request.value));
      break;
  }
  const auto read_bytes = static_cast<std::size_t>(end - read.data());
  std::byte* at = wire::write_varint(out.data(), 1 + wire::varint_bytes(serial) + 2 + read_bytes);
  *at++ = kSerialTag;
  at = wire::write_varint(at, serial);
  *at++ = kReadTag;
  *at++ = static_cast<std::byte>(read_bytes);
  std::memcpy(at, read.data(), read_bytes);
  return static_cast<std::size_t>(at - out.data()) + read_bytes;
}

}  // namespace dssm::detail
