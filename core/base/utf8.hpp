// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string_view>

namespace dssm {

// Whether `text` is well-formed UTF-8 (RFC 3629: no surrogates, no overlong forms, at most
// U+10FFFF). Names have to be: DNS-SD instance names and protobuf strings are.
bool is_utf8(std::string_view text) noexcept;

}  // namespace dssm
