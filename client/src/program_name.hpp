// SPDX-License-Identifier: Apache-2.0
//
// The name under which dssmd knows this program when its options give none.
#pragma once

#include <algorithm>
#include <cerrno>
#include <string>

#include "core/base/text.hpp"
#include "core/wire/messages.hpp"

namespace dssm::detail {

inline std::string default_program() {
  std::string name = program_invocation_short_name;
  name.resize(std::min(name.size(), wire::kMaxProgramBytes));
  return !has_control(name) && is_utf8(name) ? name : "?";
}

}  // namespace dssm::detail
