// SPDX-License-Identifier: Apache-2.0
//
// The frame that carries a sample, written by hand: this is the hot path, and the payload must not
// pass through a protobuf object. proto/network.proto is the specification; tests hold these bytes
// against stock protobuf and tests/golden.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <dssm/sample.hpp>

namespace dssm::wire {

// Length, serial, sample, and the payload's tag and length.
inline constexpr std::size_t kMaxSampleHeaderBytes = 64;
inline constexpr std::size_t kTornTrailerBytes = 3;

enum class Trailer : bool { none, torn };  // torn: kTornTrailerBytes follow the payload

// Writes all that comes before the payload's bytes; returns how many bytes.
std::size_t encode_sample_header(std::array<std::byte, kMaxSampleHeaderBytes>& out,
                                 std::uint64_t serial, const SampleInfo& info,
                                 std::size_t payload_bytes, Trailer trailer) noexcept;

// The field `torn`, to be sent directly after the payload.
std::array<std::byte, kTornTrailerBytes> torn_trailer(bool torn) noexcept;

}  // namespace dssm::wire
