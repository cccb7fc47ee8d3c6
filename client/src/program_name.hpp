// SPDX-License-Identifier: Apache-2.0
//
// What this program calls itself towards dssmd when nobody says anything else.
#pragma once

#include <algorithm>
#include <cerrno>
#include <string>

#include "core/base/utf8.hpp"
#include "core/wire/messages.hpp"

namespace dssm::detail {

inline std::string default_program() {
  std::string name = program_invocation_short_name;
  name.resize(std::min(name.size(), wire::kMaxProgramBytes));
  const bool is_printable =
      std::none_of(name.begin(), name.end(), [](unsigned char c) { return c < 0x20 || c == 0x7f; });
  return is_printable && is_utf8(name) ? name : "?";
}

}  // namespace dssm::detail
