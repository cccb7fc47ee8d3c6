// SPDX-License-Identifier: Apache-2.0
//
// Protobuf's varints by hand, for the few places that do not go through protobuf: frame lengths and
// the heads of sample frames. Seven bits a byte, lowest first; the top bit means that more follow.
#pragma once

#include <cstddef>
#include <cstdint>

namespace dssm::wire {

inline constexpr unsigned kMaxLengthBytes =
    5;  // of a frame's or a field's length: 32 bits and more
inline constexpr unsigned kMaxVarintBytes = 10;  // of any 64-bit value

// Writes `value` at `out`; returns the place after it.
inline std::byte* write_varint(std::byte* out, std::uint64_t value) noexcept {
  for (; value >= 0x80; value >>= 7) *out++ = static_cast<std::byte>(value | 0x80);
  *out++ = static_cast<std::byte>(value);
  return out;
}

inline std::size_t varint_bytes(std::uint64_t value) noexcept {
  std::size_t bytes = 1;
  for (; value >= 0x80; value >>= 7) ++bytes;
  return bytes;
}

enum class VarintStatus : unsigned char {
  ok,
  cut,       // the bytes end inside it
  too_long,  // more than max_bytes
};

// Reads one from [at, end) and moves `at` past it; on failure `at` is unchanged.
inline VarintStatus read_varint(const std::byte*& at, const std::byte* end, unsigned max_bytes,
                                std::uint64_t& value) noexcept {
  std::uint64_t result = 0;
  const std::byte* next = at;
  for (unsigned i = 0; i < max_bytes; ++i) {
    if (next == end) return VarintStatus::cut;
    const auto byte = std::to_integer<std::uint64_t>(*next++);
    result |= (byte & 0x7f) << (7 * i);
    if (!(byte & 0x80)) {
      value = result;
      at = next;
      return VarintStatus::ok;
    }
  }
  return VarintStatus::too_long;
}

}  // namespace dssm::wire
