// SPDX-License-Identifier: Apache-2.0
#include "client/dssmctl/text.hpp"

#include <array>
#include <charconv>
#include <cmath>
#include <cstdio>
#include <limits>

namespace dssm::ctl {
namespace {

constexpr std::int64_t kNsPerSecond = 1'000'000'000;
constexpr char kHexDigits[] = "0123456789abcdef";

bool printable(char c) { return c >= 0x20 && c < 0x7f; }

void add_hex(std::string& out, unsigned byte) {
  out += kHexDigits[(byte >> 4) & 15];
  out += kHexDigits[byte & 15];
}

void add_escaped(std::string& out, char c) {
  switch (c) {
    case '\n':
      out += "\\n";
      return;
    case '\t':
      out += "\\t";
      return;
    case '\r':
      out += "\\r";
      return;
    default:
      out += "\\x";
      add_hex(out, static_cast<unsigned char>(c));
  }
}

// In quotes, for messages. Built step by step: g++ 12 warns falsely (-Wrestrict) about a literal
// plus a temporary string.
std::string quoted(std::string_view text) {
  std::string out = "'";
  out += escaped(text);
  out += '\'';
  return out;
}

Error bad_seconds(std::string_view text) {
  return {Errc::invalid_argument,
          quoted(text) + " is not a number of seconds, such as 0.025 or -1.5"};
}

Error too_many_seconds(std::string_view text) {
  return {Errc::invalid_argument, quoted(text) + " seconds are more than 292 years"};
}

// Three significant digits, as far as a value below 1000 has them.
std::string three_digits(double value) {
  const double size = std::fabs(value);
  return fixed_text(value, size < 9.995 ? 2 : size < 99.95 ? 1 : 0);
}

// "2h05m"
std::string two_units(std::int64_t big, char big_unit, std::int64_t small, char small_unit) {
  std::string text = std::to_string(big) + big_unit;
  if (small < 10) text += '0';
  return text + std::to_string(small) + small_unit;
}

}  // namespace

std::string escaped(std::string_view bytes) {
  std::string out;
  for (const char c : bytes) {
    if (c == '\\') {
      out += "\\\\";
    } else if (printable(c)) {
      out += c;
    } else {
      add_escaped(out, c);
    }
  }
  return out;
}

std::string escaped_message(std::string_view message) {
  std::string out;
  for (const char c : message) {
    if (printable(c)) {
      out += c;
    } else {
      add_escaped(out, c);
    }
  }
  return out;
}

std::string list_text(const std::vector<std::string>& texts) {
  std::string out;
  for (const std::string& text : texts) out.append(out.empty() ? "" : ", ").append(escaped(text));
  return out;
}

std::string duration_text(Duration d) {
  const std::int64_t ns = to_ns(d);
  if (ns < 0) {
    const bool has_opposite = ns != std::numeric_limits<std::int64_t>::min();
    return std::string("-").append(duration_text(has_opposite ? -d : Duration::max()));
  }
  const double value = static_cast<double>(ns);
  if (ns < 1'000) return std::to_string(ns) + " ns";
  if (ns < 999'500) return three_digits(value / 1e3) + " us";
  if (ns < 999'500'000) return three_digits(value / 1e6) + " ms";
  const std::int64_t s = ns / kNsPerSecond;
  if (s < 120) return three_digits(value / 1e9) + " s";
  constexpr std::int64_t kHour = 3600, kDay = 24 * kHour;
  if (s < 2 * kHour) return two_units(s / 60, 'm', s % 60, 's');
  if (s < 2 * kDay) return two_units(s / kHour, 'h', s / 60 % 60, 'm');
  return two_units(s / kDay, 'd', s / kHour % 24, 'h');
}

std::string bound_text(Duration bound) {
  if (bound == kForeignClockError) return "of another clock";
  return bound == kUnknownClockError ? "unknown" : duration_text(bound);
}

std::string seconds_text(std::int64_t ns) {
  // By the unsigned magnitude, so that the smallest number has one too.
  const std::uint64_t size =
      ns < 0 ? 0 - static_cast<std::uint64_t>(ns) : static_cast<std::uint64_t>(ns);
  std::string fraction = std::to_string(size % kNsPerSecond);
  fraction.insert(0, 9 - fraction.size(), '0');
  std::string text = ns < 0 ? "-" : "";
  return text.append(std::to_string(size / kNsPerSecond)).append(".").append(fraction);
}

std::string fixed_text(double value, int decimals) {
  std::array<char, 400> text{};  // DBL_MAX has 309 digits before the point
  const auto [end, error] = std::to_chars(text.data(), text.data() + text.size(), value,
                                          std::chars_format::fixed, decimals);
  return error == std::errc() ? std::string(text.data(), end) : "?";
}

std::string bytes_text(std::uint64_t bytes) {
  if (bytes == 1) return "1 byte";
  if (bytes < 10'000) return std::to_string(bytes) + " bytes";
  double value = static_cast<double>(bytes) / 1024;
  for (const char* unit : {" KiB", " MiB", " GiB"}) {
    if (value < 999.5) return three_digits(value) + unit;
    value /= 1024;
  }
  return three_digits(value) + " TiB";
}

std::string byte_rate_text(double bytes_per_second) {
  double value = bytes_per_second;
  for (const char* unit : {" B/s", " kB/s", " MB/s", " GB/s"}) {
    if (std::fabs(value) < 999.5) return three_digits(value) + unit;
    value /= 1000;
  }
  return three_digits(value) + " TB/s";
}

std::string hex_text(std::span<const std::byte> bytes) {
  std::string out;
  out.reserve(bytes.size() * 2);
  for (const std::byte byte : bytes) add_hex(out, std::to_integer<unsigned>(byte));
  return out;
}

std::string hex_dump(std::span<const std::byte> bytes, std::string_view indent) {
  constexpr std::size_t kPerLine = 16;
  std::string out;
  for (std::size_t start = 0; start < bytes.size(); start += kPerLine) {
    const auto line = bytes.subspan(start, std::min(kPerLine, bytes.size() - start));
    out += indent;
    for (int shift = 28; shift >= 0; shift -= 4) out += kHexDigits[(start >> shift) & 15];
    out += ' ';
    std::string characters;
    for (std::size_t i = 0; i < kPerLine; ++i) {
      out += i == kPerLine / 2 ? "  " : " ";
      if (i < line.size()) {
        add_hex(out, std::to_integer<unsigned>(line[i]));
        const char c = std::to_integer<char>(line[i]);
        characters += printable(c) ? c : '.';
      } else {
        out += "  ";
      }
    }
    out += "  |" + characters + "|\n";
  }
  return out;
}

Result<Duration> parse_seconds(std::string_view text) {
  if (text.find_first_of("eE") != std::string_view::npos) {
    const Result<double> seconds = parse_real(text);
    if (!seconds) return bad_seconds(text);
    if (std::fabs(*seconds) > 9.2e9) return too_many_seconds(text);
    return Duration(std::llround(*seconds * 1e9));
  }
  std::string_view rest = text;
  const bool negative = rest.starts_with('-');
  if (negative || rest.starts_with('+')) rest.remove_prefix(1);
  std::int64_t ns = 0;
  int decimals = -1;  // digits after the point; -1: no point yet
  int digits = 0;
  const auto push = [&](std::int64_t digit) {
    return !__builtin_mul_overflow(ns, 10, &ns) && !__builtin_add_overflow(ns, digit, &ns);
  };
  for (const char c : rest) {
    if (c == '.' && decimals < 0) {
      decimals = 0;
    } else if (c < '0' || c > '9') {
      return bad_seconds(text);
    } else {
      ++digits;
      if (decimals >= 9) continue;
      if (!push(c - '0')) return too_many_seconds(text);
      if (decimals >= 0) ++decimals;
    }
  }
  if (digits == 0) return bad_seconds(text);
  for (int i = std::max(decimals, 0); i < 9; ++i) {
    if (!push(0)) return too_many_seconds(text);
  }
  return Duration(negative ? -ns : ns);
}

Result<std::uint64_t> parse_whole(std::string_view text, std::uint64_t least, std::uint64_t most) {
  std::uint64_t value = 0;
  const auto [end, error] = std::from_chars(text.data(), text.data() + text.size(), value);
  if (error != std::errc() || end != text.data() + text.size() || value < least || value > most) {
    std::string range = "from " + std::to_string(least);
    if (most != std::numeric_limits<std::uint64_t>::max()) range += " to " + std::to_string(most);
    return Error{Errc::invalid_argument, quoted(text) + " is not a whole number " + range};
  }
  return value;
}

Result<double> parse_real(std::string_view text) {
  double value = 0;
  std::string_view digits = text;
  if (digits.starts_with('+')) digits.remove_prefix(1);  // from_chars takes no plus sign
  const auto [end, error] = std::from_chars(digits.data(), digits.data() + digits.size(), value);
  if (error != std::errc() || end != digits.data() + digits.size() || !std::isfinite(value)) {
    return Error{Errc::invalid_argument, quoted(text) + " is not a number"};
  }
  return value;
}

Duration saturating_sub(Time a, Time b) {
  std::int64_t difference = 0;
  if (!__builtin_sub_overflow(to_ns(a), to_ns(b), &difference)) return Duration(difference);
  return a > b ? Duration::max() : Duration::min();
}

Time saturating_add(Time a, Duration b) {
  std::int64_t sum = 0;
  if (!__builtin_add_overflow(to_ns(a), to_ns(b), &sum)) return time_from_ns(sum);
  return b > Duration::zero() ? Time::max() : Time::min();
}

}  // namespace dssm::ctl
