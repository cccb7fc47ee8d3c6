// SPDX-License-Identifier: Apache-2.0
#include "client/dssmctl/text.hpp"

#include <fmt/format.h>

#include <array>
#include <charconv>
#include <cmath>
#include <cstdio>
#include <limits>

namespace dssm::ctl {
namespace {

constexpr std::int64_t kNsPerSecond = 1'000'000'000;
bool printable(char c) { return c >= 0x20 && c < 0x7f; }

// `bytes` with what cannot be printed, and what `escape_too` names, as escape sequences.
std::string escape(std::string_view bytes, std::string_view escape_too) {
  std::string out;
  for (const char c : bytes) {
    if (c == '\n') {
      out += "\\n";
    } else if (c == '\t') {
      out += "\\t";
    } else if (c == '\r') {
      out += "\\r";
    } else if (!printable(c)) {
      out += fmt::format("\\x{:02x}", static_cast<unsigned char>(c));
    } else {
      if (escape_too.find(c) != std::string_view::npos) out += '\\';
      out += c;
    }
  }
  return out;
}

// "'abc' is not a number"
Error bad(std::string_view text, std::string_view problem) {
  return {Errc::invalid_argument, fmt::format("'{}' {}", escaped(text), problem)};
}

Error bad_seconds(std::string_view text) {
  return bad(text, "is not a number of seconds, such as 0.025 or -1.5");
}

Error too_many_seconds(std::string_view text) {
  return bad(text, "seconds are more than 292 years");
}

// Three significant digits, as far as a value below 1000 has them.
std::string three_digits(double value) {
  const double size = std::fabs(value);
  return fixed_text(value, size < 9.995 ? 2 : size < 99.95 ? 1 : 0);
}

// "2h05m"
std::string two_units(std::int64_t big, char big_unit, std::int64_t small, char small_unit) {
  return fmt::format("{}{}{:02}{}", big, big_unit, small, small_unit);
}

}  // namespace

std::string escaped(std::string_view bytes) { return escape(bytes, "\\"); }

std::string escaped_message(std::string_view message) { return escape(message, ""); }

std::string list_text(const std::vector<std::string>& texts) {
  std::string out;
  for (const std::string& text : texts) out.append(out.empty() ? "" : ", ").append(escaped(text));
  return out;
}

std::string or_dash(const std::string& text) { return text.empty() ? "-" : text; }

std::string duration_text(Duration d) {
  const std::int64_t ns = to_ns(d);
  if (ns < 0) {
    const bool has_opposite = ns != std::numeric_limits<std::int64_t>::min();
    return "-" + duration_text(has_opposite ? -d : Duration::max());
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

std::string ns_text(double ns) { return duration_text(Duration(std::llround(ns))); }

std::string bound_text(Duration bound) {
  if (bound == kForeignClockError) return "of another clock";
  return bound == kUnknownClockError ? "unknown" : duration_text(bound);
}

std::string bar_text(Duration bound, Duration limit) {
  constexpr std::size_t kCells = 10;
  if (bound == kUnknownClockError) return "-";
  if (bound > limit) return "[" + std::string(kCells, '#') + ">";
  std::string cells;
  if (bound > Duration::zero()) {
    const double tenths =
        kCells * static_cast<double>(to_ns(bound)) / static_cast<double>(to_ns(limit));
    cells.assign(static_cast<std::size_t>(std::ceil(tenths)), '#');
  }
  cells.resize(kCells, ' ');
  return "[" + cells + "]";
}

std::string seconds_text(std::int64_t ns) {
  // By the unsigned magnitude, so that the smallest number has one too.
  const std::uint64_t size =
      ns < 0 ? 0 - static_cast<std::uint64_t>(ns) : static_cast<std::uint64_t>(ns);
  return fmt::format("{}{}.{:09}", ns < 0 ? "-" : "", size / kNsPerSecond, size % kNsPerSecond);
}

std::string fixed_text(double value, int decimals) {
  return fmt::format("{:.{}f}", value, decimals);
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
  for (const char* unit : {" B/s", " KiB/s", " MiB/s", " GiB/s"}) {
    if (std::fabs(value) < 999.5) return three_digits(value) + unit;
    value /= 1024;
  }
  return three_digits(value) + " TiB/s";
}

std::string hex_text(std::span<const std::byte> bytes) {
  constexpr char kDigits[] = "0123456789abcdef";
  std::string out;
  out.reserve(bytes.size() * 2);
  for (const std::byte byte : bytes) {  // by hand: there may be 64 MiB of them
    out += kDigits[std::to_integer<unsigned>(byte) >> 4];
    out += kDigits[std::to_integer<unsigned>(byte) & 15];
  }
  return out;
}

std::string hex_dump(std::span<const std::byte> bytes, std::string_view indent) {
  constexpr std::size_t kPerLine = 16;
  std::string out;
  for (std::size_t start = 0; start < bytes.size(); start += kPerLine) {
    const auto line = bytes.subspan(start, std::min(kPerLine, bytes.size() - start));
    out += fmt::format("{}{:08x} ", indent, start);
    std::string characters;
    for (std::size_t i = 0; i < kPerLine; ++i) {
      out += i == kPerLine / 2 ? "  " : " ";
      if (i >= line.size()) {
        out += "  ";
        continue;
      }
      out += fmt::format("{:02x}", std::to_integer<unsigned>(line[i]));
      const char c = std::to_integer<char>(line[i]);
      characters += printable(c) ? c : '.';
    }
    out += fmt::format("  |{}|\n", characters);
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

Result<std::uint64_t> parse_whole(std::string_view text, std::uint64_t min, std::uint64_t max) {
  std::uint64_t value = 0;
  const auto [end, error] = std::from_chars(text.data(), text.data() + text.size(), value);
  if (error != std::errc() || end != text.data() + text.size() || value < min || value > max) {
    const bool bounded = max != std::numeric_limits<std::uint64_t>::max();
    return bad(text, fmt::format("is not a whole number from {}{}", min,
                                 bounded ? fmt::format(" to {}", max) : ""));
  }
  return value;
}

Result<double> parse_real(std::string_view text) {
  double value = 0;
  std::string_view digits = text;
  if (digits.starts_with('+')) digits.remove_prefix(1);  // from_chars takes no plus sign
  const auto [end, error] = std::from_chars(digits.data(), digits.data() + digits.size(), value);
  if (error != std::errc() || end != digits.data() + digits.size() || !std::isfinite(value)) {
    return bad(text, "is not a number");
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
