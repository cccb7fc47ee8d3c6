// SPDX-License-Identifier: Apache-2.0
//
// The size of the largest samples in tests: the maximum, except under sanitizers that need a
// hundred bytes for each of theirs.
#pragma once

#include <cstddef>
#include <dssm/stream.hpp>

namespace dssm::test {

#if defined(__SANITIZE_THREAD__)
// It remembers every word that is copied as one: a test with 64 MiB took 7 GiB of memory, and three
// of them side by side all that a machine had; one with 8 MiB took 48 s on a slow one.
inline constexpr std::size_t kLargestPayloadBytes = 2 << 20;
#else
inline constexpr std::size_t kLargestPayloadBytes = kMaxPayloadBytes;
#endif

}  // namespace dssm::test
