// SPDX-License-Identifier: Apache-2.0
//
// Bugs of our own: DSSM_CHECK(x) ends the process with a text, in release builds too. Never for
// anything that comes from outside.
#pragma once

namespace dssm {
[[noreturn]] void check_failed(const char* expression, const char* file, int line) noexcept;
}

#define DSSM_CHECK(x) \
  (static_cast<bool>(x) ? static_cast<void>(0) : ::dssm::check_failed(#x, __FILE__, __LINE__))
