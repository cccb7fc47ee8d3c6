// SPDX-License-Identifier: Apache-2.0
//
// The frame that asks for one sample, written by hand: a read is one round trip, and building it as
// a protobuf object took a twentieth of that. proto/network.proto is the specification; the test
// holds these bytes against protobuf's.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <dssm/sample.hpp>

namespace dssm::detail {

// Which sample is asked for. A value.
struct ReadRequest {
  enum class Which : std::uint8_t { tid, time, newest, newer_than };  // as in net::Read
  Which which = Which::newest;
  std::int64_t value = 0;  // a tid, or nanoseconds
};

inline constexpr std::size_t kMaxReadRequestBytes = 32;

// Writes the frame, with its length; returns how many bytes.
std::size_t encode_read_request(std::array<std::byte, kMaxReadRequestBytes>& out,
                                std::uint64_t serial, const ReadRequest& request) noexcept;

}  // namespace dssm::detail
