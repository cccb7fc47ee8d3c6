// SPDX-License-Identifier: Apache-2.0
#pragma once

namespace dssm::test {

// With a sanitizer programs are slow; what shows nothing more there is left to other builds, and
// what is tried with random values is tried less often.
#if defined(__SANITIZE_ADDRESS__) || defined(__SANITIZE_THREAD__)
inline constexpr bool kIsSanitized = true;
#else
inline constexpr bool kIsSanitized = false;
#endif

}  // namespace dssm::test
