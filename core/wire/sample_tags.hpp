// SPDX-License-Identifier: Apache-2.0
//
// The tags of proto/network.proto that are written and read by hand: field number times 8 plus wire
// type (0 varint, 1 eight bytes, 2 length-delimited). tests/unit/core/wire holds them against
// protobuf.
#pragma once

#include <array>
#include <cstddef>

namespace dssm::wire {

// Of Frame.
inline constexpr std::byte kSerialTag{1 << 3 | 0};
inline constexpr std::byte kSampleTag{2 << 3 | 2};
inline constexpr std::byte kPayloadTag{15 << 3 | 2};
inline constexpr std::array kTornTag = {std::byte{0x88},
                                        std::byte{0x02}};  // 33 << 3 | 0: two bytes

// Of Sample.
inline constexpr std::byte kTidTag{1 << 3 | 1};
inline constexpr std::byte kTimeTag{2 << 3 | 1};
inline constexpr std::byte kClockErrorTag{3 << 3 | 1};
inline constexpr std::size_t kFixed64FieldBytes = 9;  // tag and value

}  // namespace dssm::wire
