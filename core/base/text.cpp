// SPDX-License-Identifier: Apache-2.0
#include "core/base/text.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <optional>

namespace dssm {

namespace {

// The character at the beginning of `text`, in UTF-8; nullopt: there is none. Its bytes are taken
// from `text`, or one byte.
std::optional<std::uint32_t> take_character(std::string_view& text) noexcept {
  const auto lead = static_cast<std::uint8_t>(text.front());
  text.remove_prefix(1);
  if (lead < 0x80) return lead;
  std::size_t more = 0;
  std::uint32_t smallest = 0, value = 0;
  if ((lead & 0xe0) == 0xc0) {
    more = 1, smallest = 0x80, value = lead & 0x1fU;
  } else if ((lead & 0xf0) == 0xe0) {
    more = 2, smallest = 0x800, value = lead & 0x0fU;
  } else if ((lead & 0xf8) == 0xf0) {
    more = 3, smallest = 0x10000, value = lead & 0x07U;
  } else {
    return std::nullopt;
  }
  if (more > text.size()) return std::nullopt;
  for (const char c : text.substr(0, more)) {
    const auto byte = static_cast<std::uint8_t>(c);
    if ((byte & 0xc0) != 0x80) return std::nullopt;
    value = (value << 6) | (byte & 0x3fU);
  }
  if (value < smallest || value > 0x10ffff || (value >= 0xd800 && value <= 0xdfff)) {
    return std::nullopt;
  }
  text.remove_prefix(more);
  return value;
}

// Controls of C0 and C1, line and paragraph separators, and the marks that turn the direction of
// writing (Unicode Standard Annex 9): with them a terminal shows another text than there is.
constexpr bool changes_display(std::uint32_t c) noexcept {
  return c < 0x20 || (c >= 0x7f && c < 0xa0) || c == 0x61c || c == 0x200e || c == 0x200f ||
         (c >= 0x2028 && c <= 0x202e) || (c >= 0x2066 && c <= 0x2069);
}

}  // namespace

bool is_utf8(std::string_view text) noexcept {
  while (!text.empty()) {
    if (!take_character(text)) return false;
  }
  return true;
}

bool has_control(std::string_view text) noexcept {
  return std::any_of(text.begin(), text.end(), is_control);
}

std::string printable(std::string_view text) {
  std::string out;
  out.reserve(text.size());
  while (!text.empty()) {
    const std::string_view from = text;
    const std::optional<std::uint32_t> character = take_character(text);
    if (!character || changes_display(*character)) {
      out += '?';
    } else {
      out += from.substr(0, from.size() - text.size());
    }
  }
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
