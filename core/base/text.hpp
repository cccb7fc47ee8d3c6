// SPDX-License-Identifier: Apache-2.0
//
// Checks and conversions of short texts: names, messages, ids.
#pragma once

#include <cstdint>
#include <dssm/result.hpp>
#include <span>
#include <string>
#include <string_view>

namespace dssm {

// Whether `text` is well-formed UTF-8 (RFC 3629: no surrogates, no overlong forms, at most
// U+10FFFF). Names must be: DNS-SD instance names and protobuf strings are. Written here because a
// library for it would become a dependency of libdssm.
bool is_utf8(std::string_view text) noexcept;

// ASCII only, whatever the locale.
constexpr bool is_control(char c) noexcept {
  return static_cast<unsigned char>(c) < 0x20 || c == 0x7f;
}
constexpr bool is_letter_or_digit(char c) noexcept {
  return (c >= 'a' && c <= 'z') || (c >= 'A' && c <= 'Z') || (c >= '0' && c <= '9');
}

bool has_control(std::string_view text) noexcept;

// `text` with a '?' for each control character, each mark that changes the direction of writing,
// and each byte that is no UTF-8: a name chosen by a client cannot forge lines of a log or a
// terminal.
std::string printable(std::string_view text);

// The same in single quotes, as messages show it.
std::string in_quotes(std::string_view text);

// Two hexadecimal digits per byte: "00ff10". Of a number: 16 digits, the most significant first.
std::string hex(std::span<const std::uint8_t> bytes);
std::string hex(std::string_view bytes);
std::string hex(std::uint64_t number);

// The name of a host: 1 to kMaxHostBytes letters, digits and '-'.
//   fails  invalid_argument, with a sentence that quotes `text`
inline constexpr std::size_t kMaxHostBytes = 31;
Result<void> check_host_name(std::string_view text);

}  // namespace dssm
