// SPDX-License-Identifier: Apache-2.0
#include "core/ring/geometry.hpp"

#include <fmt/core.h>

#include <dssm/stream.hpp>

#include "core/ring/layout.hpp"

namespace dssm::ring {
namespace {

constexpr std::uint64_t round_up(std::uint64_t value, std::uint64_t unit) noexcept {
  return (value + unit - 1) / unit * unit;
}

}  // namespace

Result<Geometry> Geometry::of(std::uint64_t payload_bytes, std::uint64_t depth) {
  if (payload_bytes < 1 || payload_bytes > kMaxPayloadBytes) {
    return Error{Errc::invalid_argument,
                 fmt::format("a payload of {} bytes is not possible; it takes 1 byte to 64 MiB",
                             payload_bytes)};
  }
  if (depth < kMinDepth || depth > kMaxDepth) {
    return Error{Errc::invalid_argument,
                 fmt::format("a depth of {} slots is not possible; it takes 2 to 16777216", depth)};
  }
  Geometry geometry;
  geometry.payload_bytes = payload_bytes;
  geometry.depth = depth;
  geometry.slot_bytes = round_up(sizeof(SlotHeader) + payload_bytes + kGuardBytes, kLineBytes);
  geometry.times_offset = sizeof(RingHeader);
  geometry.slots_offset = geometry.times_offset + round_up(8 * depth, kPageBytes);
  geometry.total_bytes = round_up(geometry.slots_offset + depth * geometry.slot_bytes, kPageBytes);
  return geometry;  // at most 2^24 * (2^26 + 128) + ..., far below 2^63
}

}  // namespace dssm::ring
