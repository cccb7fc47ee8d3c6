// SPDX-License-Identifier: Apache-2.0
#include "core/base/text.hpp"

#include <fmt/format.h>

#include <algorithm>

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

bool has_control(std::string_view text) noexcept {
  return std::any_of(text.begin(), text.end(), is_control);
}

std::string printable(std::string_view text) {
  std::string out(text);
  std::replace_if(out.begin(), out.end(), is_control, '?');
  return out;
}

std::string in_quotes(std::string_view text) { return "'" + printable(text) + "'"; }

std::string hex(std::span<const std::uint8_t> bytes) {
  return fmt::format("{:02x}", fmt::join(bytes, ""));
}

std::string hex(std::string_view bytes) {
  return hex({reinterpret_cast<const std::uint8_t*>(bytes.data()), bytes.size()});
}

std::string hex(std::uint64_t number) { return fmt::format("{:016x}", number); }

Result<void> check_host_name(std::string_view text) {
  if (text.empty() || text.size() > kMaxHostBytes) {
    return Error{Errc::invalid_argument,
                 fmt::format("{} is {} bytes long; a host's name takes 1 to {}", in_quotes(text),
                             text.size(), kMaxHostBytes)};
  }
  const bool is_name = std::all_of(text.begin(), text.end(),
                                   [](char c) { return is_letter_or_digit(c) || c == '-'; });
  if (is_name) return {};
  return Error{Errc::invalid_argument,
               in_quotes(text) + " contains other characters than letters, digits and '-'"};
}

}  // namespace dssm
