// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstdint>
#include <string_view>

namespace dssm {

using Sha256 = std::array<std::uint8_t, 32>;

// The SHA-256 digest of `bytes` (FIPS 180-4). Written for short inputs that are hashed once in a
// process's life, not for speed.
Sha256 sha256(std::string_view bytes);

}  // namespace dssm
