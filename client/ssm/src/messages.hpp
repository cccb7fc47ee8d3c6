// SPDX-License-Identifier: Apache-2.0
//
// What this library reports to people: lines on stderr, and the text that errSSM() prints.
#pragma once

#include <fmt/format.h>

#include <algorithm>
#include <cstdio>
#include <cstring>
#include <dssm/error.hpp>
#include <string_view>

namespace dssm::ssm {

// The text that errSSM() prints; "" if there was no error. Per thread and of fixed size: no lock
// that a signal handler could meet, nothing to free.
inline thread_local char last_error[512];

// Keeps `text` for errSSM() of this thread.
inline void remember_error(std::string_view text) noexcept {
  const std::size_t length = std::min(text.size(), sizeof last_error - 1);
  std::memcpy(last_error, text.data(), length);
  last_error[length] = '\0';
}

// The same, and prints "SSM ERROR : `text`" to stderr.
inline void report_error(std::string_view text) noexcept {
  remember_error(text);
  std::fprintf(stderr, "SSM ERROR : %.*s\n", static_cast<int>(text.size()), text.data());
}

// The same for a failure of `what`.
inline void report_failure(std::string_view what, const Error& error) {
  report_error(fmt::format("{} : {}", what, error.message));
}

}  // namespace dssm::ssm
