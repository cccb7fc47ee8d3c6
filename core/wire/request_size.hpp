// SPDX-License-Identifier: Apache-2.0
//
// What a message would cost, found before protobuf parses it: two bytes may make an object of a
// hundred, with an allocation or two. So there are limits on the bytes that may do so, in both
// protocols.
#pragma once

#include <cstddef>
#include <cstdint>
#include <dssm/result.hpp>
#include <span>
#include <string>
#include <string_view>

namespace dssm::wire {

inline constexpr std::size_t kMaxRequestBytes = 16U << 10;  // without a property
// The same of a Create or Describe: its type has up to kMaxFields fields. More of them are refused
// with an answer, far more before they are parsed.
inline constexpr std::size_t kMaxCreateBytes = 256U << 10;
inline constexpr std::size_t kMaxParsedFields = 4096;

// Whether a request may be parsed.
//   fails  limit_exceeded, protocol (it is long, and no message)
Result<void> check_request_size_untrusted(std::span<const std::byte> message);

// Whether a frame of the network protocol may be parsed, as to its elements: what is repeated in
// it, as the streams of a list. An element takes some hundred bytes of memory and may be two bytes
// long; those of ours are longer, or few: on average at least kMinFieldBytes for a type's field or
// a node's stream, kMinNodeBytes for a node and kMinElementBytes for another element, but for
// kFreeElementBytes in all.
inline constexpr std::size_t kMinFieldBytes = 8;
inline constexpr std::size_t kMinNodeBytes = 16;
inline constexpr std::size_t kMinElementBytes = 32;
inline constexpr std::size_t kFreeElementBytes = 128U << 10;
//   fails  protocol
Result<void> check_elements_untrusted(std::span<const std::byte> frame);

// The serial of a request that is not parsed; 0 when it does not begin with it, as protobuf writes
// it.
std::uint64_t serial_untrusted(std::span<const std::byte> message) noexcept;

}  // namespace dssm::wire
