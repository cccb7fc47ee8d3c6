// SPDX-License-Identifier: Apache-2.0
//
// What this library says to people: lines on stderr, and the text that errSSM() prints.
#pragma once

#include <string_view>

namespace dssm::ssm {

// Keeps `text` for errSSM() of this thread.
void remember_error(std::string_view text) noexcept;

// The same, and prints "SSM ERROR : `text`" to stderr.
void report_error(std::string_view text) noexcept;

// What this thread remembered last; "" if nothing.
const char* remembered_error() noexcept;

}  // namespace dssm::ssm
