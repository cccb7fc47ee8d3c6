// SPDX-License-Identifier: Apache-2.0
//
// Offsets and sizes in a ring: follow from payload size and depth, and are checked when read from a
// mapping.
#pragma once

#include <cstdint>
#include <dssm/result.hpp>

namespace dssm::ring {

struct Geometry {
  std::uint64_t payload_bytes = 0;
  std::uint64_t depth = 0;
  std::uint64_t slot_bytes = 0;    // distance between slots, multiple of 64
  std::uint64_t times_offset = 0;  // of the time index, from the mapping's start
  std::uint64_t slots_offset = 0;  // of slot 0
  std::uint64_t total_bytes = 0;   // of the whole ring, multiple of the page size

  // The geometry for these. Fails with invalid_argument, naming value and range: payload 1 byte to
  // 64 MiB, depth 2 to 2^24.
  static Result<Geometry> of(std::uint64_t payload_bytes, std::uint64_t depth);

  friend bool operator==(const Geometry&, const Geometry&) = default;
};

}  // namespace dssm::ring
