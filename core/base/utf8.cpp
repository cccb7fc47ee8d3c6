// SPDX-License-Identifier: Apache-2.0
#include "core/base/utf8.hpp"

#include <cstdint>

namespace dssm {

bool is_utf8(std::string_view text) noexcept {
  for (std::size_t i = 0; i < text.size();) {
    const auto lead = static_cast<std::uint8_t>(text[i++]);
    if (lead < 0x80) continue;
    int more = 0;
    std::uint32_t smallest = 0, value = 0;
    if ((lead & 0xe0) == 0xc0) {
      more = 1, smallest = 0x80, value = lead & 0x1fU;
    } else if ((lead & 0xf0) == 0xe0) {
      more = 2, smallest = 0x800, value = lead & 0x0fU;
    } else if ((lead & 0xf8) == 0xf0) {
      more = 3, smallest = 0x10000, value = lead & 0x07U;
    } else {
      return false;
    }
    for (; more > 0; --more) {
      if (i == text.size()) return false;
      const auto byte = static_cast<std::uint8_t>(text[i++]);
      if ((byte & 0xc0) != 0x80) return false;
      value = (value << 6) | (byte & 0x3fU);
    }
    if (value < smallest || value > 0x10ffff || (value >= 0xd800 && value <= 0xdfff)) return false;
  }
  return true;
}

}  // namespace dssm
