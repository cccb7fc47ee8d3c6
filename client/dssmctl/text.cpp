// SPDX-License-Identifier: Apache-2.0
#include "client/dssmctl/text.hpp"

#include <fmt/chrono.h>
#include <fmt/format.h>
#include <langinfo.h>
#include <wchar.h>

#include <algorithm>
#include <array>
#include <charconv>
#include <cmath>
#include <cstdio>
#include <ctime>
#include <iterator>
#include <limits>
#include <utility>

#include "core/base/try.hpp"

namespace dssm::ctl {
namespace {

constexpr std::int64_t kNsPerSecond = 1'000'000'000;
__extension__ using Int128 = __int128;
bool printable(char c) { return c >= 0x20 && c < 0x7f; }

bool prints_utf8 = false;

// The character that `text` begins with, and how many bytes it has; 0: it is not UTF-8.
std::size_t decode(std::string_view text, char32_t& character) {
  const auto byte = [&](std::size_t i) { return static_cast<unsigned char>(text[i]); };
  const unsigned char lead = byte(0);
  const std::size_t size = lead < 0x80   ? 1
                           : lead < 0xc2 ? 0
                           : lead < 0xe0 ? 2
                           : lead < 0xf0 ? 3
                           : lead < 0xf5 ? 4
                                         : 0;
  if (size == 0 || text.size() < size) return 0;
  character = size == 1 ? lead : lead & (0x7fU >> size);
  for (std::size_t i = 1; i < size; ++i) {
    if ((byte(i) & 0xc0U) != 0x80) return 0;
    character = (character << 6) | (byte(i) & 0x3fU);
  }
  const bool is_overlong = (size == 3 && character < 0x800) || (size == 4 && character < 0x10000);
  const bool is_surrogate = character >= 0xd800 && character < 0xe000;
  return is_overlong || is_surrogate || character > 0x10ffff ? 0 : size;
}

// Characters that are not seen, or that change how others are: soft hyphen, fillers, joiners, marks
// and overrides of the direction, variation selectors, tags.
bool is_treacherous(char32_t c) {
  constexpr std::pair<char32_t, char32_t> kRanges[] = {
      {0xad, 0xad},     {0x34f, 0x34f},   {0x61c, 0x61c},   {0x115f, 0x1160}, {0x17b4, 0x17b5},
      {0x180b, 0x180f}, {0x200b, 0x200f}, {0x2028, 0x202e}, {0x2060, 0x206f}, {0x3164, 0x3164},
      {0xfe00, 0xfe0f}, {0xfeff, 0xfeff}, {0xffa0, 0xffa0}, {0xfff0, 0xfffb}, {0xe0000, 0xe0fff}};
  return std::any_of(std::begin(kRanges), std::end(kRanges),
                     [c](const auto& range) { return c >= range.first && c <= range.second; });
}

// Its columns on the screen; 0: it is not to be printed.
std::size_t character_columns(char32_t c) {
  if (c < 0x80) return printable(static_cast<char>(c)) ? 1 : 0;
  if (!prints_utf8 || is_treacherous(c)) return 0;
  const int width = ::wcwidth(static_cast<wchar_t>(c));
  return width > 0 ? static_cast<std::size_t>(width) : 0;
}

// `bytes` with what cannot be printed, and what `escape_too` names, as escape sequences.
std::string escape(std::string_view bytes, std::string_view escape_too) {
  std::string out;
  while (!bytes.empty()) {
    const char c = bytes.front();
    char32_t character = 0;
    const std::size_t size = decode(bytes, character);
    if (size > 1 && character_columns(character) > 0) {
      out += bytes.substr(0, size);
      bytes.remove_prefix(size);
      continue;
    }
    bytes.remove_prefix(1);
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

Error bad_duration(std::string_view text) {
  return bad(text,
             "is not a duration: write seconds, such as 0.025, or a unit, such as 25ms or 2min");
}

Error too_long(std::string_view text) { return bad(text, "is more than 292 years"); }

Error bad_moment(std::string_view text) {
  return bad(text,
             "is not a time: write seconds since 1970, such as 1700000000.25, ISO 8601, such as "
             "2026-11-27T08:00:00Z, now, -3s, or, of a recording, +2s");
}

struct Unit {
  std::string_view name;
  std::int64_t ns;
};
constexpr Unit kUnits[] = {{"ns", 1},
                           {"us", 1'000},
                           {"ms", 1'000'000},
                           {"s", kNsPerSecond},
                           {"min", 60 * kNsPerSecond},
                           {"h", 3600 * kNsPerSecond},
                           {"d", kNsPerSecond * 24 * 3600}};

// Takes the unit off the end of `text`, if there is one; seconds otherwise.
Unit take_unit(std::string_view& text) {
  const std::size_t end = text.find_last_of("0123456789.");
  const std::string_view name = end == std::string_view::npos ? text : text.substr(end + 1);
  for (const Unit& unit : kUnits) {
    if (name != unit.name) continue;
    text.remove_suffix(name.size());
    return unit;
  }
  return {"", kNsPerSecond};
}

// Reads exactly `digits` digits off the beginning of `text`.
bool take_number(std::string_view& text, std::size_t digits, int& value) {
  if (text.size() < digits) return false;
  const auto [end, error] = std::from_chars(text.data(), text.data() + digits, value);
  if (error != std::errc() || end != text.data() + digits || text[0] == '-') return false;
  text.remove_prefix(digits);
  return true;
}

bool take(std::string_view& text, char c) {
  if (!text.starts_with(c)) return false;
  text.remove_prefix(1);
  return true;
}

// ".123" as nanoseconds; digits after the ninth are cut off.
bool take_fraction(std::string_view& text, std::int64_t& ns) {
  if (!take(text, '.') && !take(text, ',')) return true;
  std::int64_t digit_ns = kNsPerSecond / 10;
  bool any = false;
  for (; !text.empty() && text[0] >= '0' && text[0] <= '9'; text.remove_prefix(1)) {
    ns += (text[0] - '0') * digit_ns;
    digit_ns /= 10;
    any = true;
  }
  return any;
}

// "Z", "+09:00", "+0900", "+09"; nullopt: none, so the time is local.
bool take_offset(std::string_view& text, std::optional<int>& offset_s) {
  if (text.empty()) return true;
  if (take(text, 'Z') || take(text, 'z')) {
    offset_s = 0;
    return true;
  }
  const int sign = text[0] == '-' ? -1 : 1;
  int hours = 0, minutes = 0;
  if ((!take(text, '+') && !take(text, '-')) || !take_number(text, 2, hours)) return false;
  if (!text.empty()) {
    take(text, ':');
    if (!take_number(text, 2, minutes)) return false;
  }
  offset_s = sign * (hours * 3600 + minutes * 60);
  return hours < 24 && minutes < 60;
}

// Whether `text` begins as a date does.
bool is_date(std::string_view text) {
  int year = 0;
  return take_number(text, 4, year) && text.starts_with('-');
}

Result<Time> parse_iso(std::string_view text) {
  std::string_view rest = text;
  std::tm parts{};
  std::int64_t ns = 0;
  std::optional<int> offset_s;
  bool good = take_number(rest, 4, parts.tm_year) && take(rest, '-') &&
              take_number(rest, 2, parts.tm_mon) && take(rest, '-') &&
              take_number(rest, 2, parts.tm_mday);
  if (good && !rest.empty()) {
    good = (take(rest, 'T') || take(rest, ' ')) && take_number(rest, 2, parts.tm_hour) &&
           take(rest, ':') && take_number(rest, 2, parts.tm_min);
    if (good && take(rest, ':')) {
      good = take_number(rest, 2, parts.tm_sec) && take_fraction(rest, ns);
    }
    good = good && take_offset(rest, offset_s) && rest.empty();
  }
  if (!good || parts.tm_hour > 23 || parts.tm_min > 59 || parts.tm_sec > 59) {
    return bad_moment(text);
  }
  parts.tm_year -= 1900;
  parts.tm_mon -= 1;
  parts.tm_isdst = -1;
  const int month = parts.tm_mon, day = parts.tm_mday;
  std::tm normal = parts;
  ::timegm(&normal);  // normalizes what no calendar has
  if (month < 0 || day < 1 || normal.tm_mon != month || normal.tm_mday != day) {
    return bad(text, "is not a day of the calendar");
  }
  const std::int64_t s = offset_s ? ::timegm(&parts) - *offset_s : ::mktime(&parts);
  const Int128 total = Int128{s} * kNsPerSecond + ns;
  if (total < std::numeric_limits<std::int64_t>::min() ||
      total > std::numeric_limits<std::int64_t>::max()) {
    return bad(text, "is not between the years 1678 and 2261, as times of samples are");
  }
  return time_from_ns(static_cast<std::int64_t>(total));
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

void use_locale() {
  // NOLINTNEXTLINE(concurrency-mt-unsafe): called once, before there are threads
  prints_utf8 = std::string_view(::nl_langinfo(CODESET)) == "UTF-8";
}

std::size_t columns_of(std::string_view text) {
  std::size_t columns = 0;
  while (!text.empty()) {
    char32_t character = 0;
    const std::size_t size = std::max<std::size_t>(1, decode(text, character));
    columns += character_columns(character);
    text.remove_prefix(size);
  }
  return columns;
}

std::string shortened(std::string_view text, std::size_t columns) {
  if (columns_of(text) <= columns) return std::string(text);
  const std::string_view end = prints_utf8 ? "\u2026" : "...";
  const std::size_t rest = columns - std::min(columns, columns_of(end));
  std::size_t bytes = 0;
  for (std::size_t used = 0; bytes < text.size();) {
    char32_t character = 0;
    const std::size_t size = std::max<std::size_t>(1, decode(text.substr(bytes), character));
    used += character_columns(character);
    if (used > rest) break;
    bytes += size;
  }
  return std::string(text.substr(0, bytes)).append(end);
}

std::string double_quoted(std::string_view text) { return "\"" + escape(text, "\\\"") + "\""; }

std::string escaped(std::string_view bytes) { return escape(bytes, "\\"); }

std::string escaped_message(std::string_view message) { return escape(message, ""); }

std::string list_text(const std::vector<std::string>& texts, std::size_t at_most) {
  std::string out;
  for (std::size_t i = 0; i < std::min(texts.size(), at_most); ++i) {
    out.append(out.empty() ? "" : ", ").append(escaped(texts[i]));
  }
  if (texts.size() > at_most) out += fmt::format(", and {} more", texts.size() - at_most);
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

std::string iso_text(Time time) {
  const std::int64_t ns = to_ns(time);
  std::int64_t fraction = ns % kNsPerSecond;
  std::time_t s = ns / kNsPerSecond;
  if (fraction < 0) {
    fraction += kNsPerSecond;
    --s;
  }
  return fmt::format("{:%Y-%m-%dT%H:%M:%S}.{:09}Z", fmt::gmtime(s), fraction);
}

Result<Duration> parse_duration(std::string_view text) {
  std::string_view number = text;
  const Unit unit = take_unit(number);
  if (number.find_first_of("eE") != std::string_view::npos) {
    const Result<double> value = parse_real(number);
    if (!value) return bad_duration(text);
    const double ns = *value * static_cast<double>(unit.ns);
    if (std::fabs(ns) > 9.2e18) return too_long(text);
    return Duration(std::llround(ns));
  }
  std::string_view rest = number;
  const bool negative = rest.starts_with('-');
  if (negative || rest.starts_with('+')) rest.remove_prefix(1);
  // In billionths of the unit: 18 digits before the point and 9 after it fit.
  Int128 value = 0;
  int decimals = -1;  // digits after the point; -1: no point yet
  int whole = 0;      // digits before it, without leading zeros
  bool any = false;
  for (const char c : rest) {
    if (c == '.' && decimals < 0) {
      decimals = 0;
      continue;
    }
    if (c < '0' || c > '9') return bad_duration(text);
    any = true;
    if (decimals >= 9) continue;
    if (decimals >= 0) ++decimals;
    if (decimals < 0 && (whole > 0 || c != '0') && ++whole > 19) return too_long(text);
    value = value * 10 + (c - '0');
  }
  if (!any) return bad_duration(text);
  for (int i = std::max(decimals, 0); i < 9; ++i) value *= 10;
  if (value > Int128{std::numeric_limits<std::int64_t>::max()} * kNsPerSecond / unit.ns) {
    return too_long(text);
  }
  const auto ns = static_cast<std::int64_t>(value * unit.ns / kNsPerSecond);
  return Duration(negative ? -ns : ns);
}

Result<Moment> parse_moment(std::string_view text, Time now) {
  if (text == "now") return Moment{now};
  if (is_date(text)) return Moment{DSSM_TRY(parse_iso(text))};
  std::string_view number = text;
  const bool has_unit = !take_unit(number).name.empty();
  const bool is_back = text.starts_with('-');
  Result<Duration> value = parse_duration(text);
  if (!value && value.error().message.find("292") != std::string::npos) return value.error();
  if (!value || (has_unit && !is_back)) return bad_moment(text);
  return is_back ? Moment{{}, *value} : Moment{Time(*value)};
}

Result<Moment> parse_recorded_moment(std::string_view text, Time now) {
  if (!text.starts_with('+')) return parse_moment(text, now);
  const std::string_view rest = text.substr(1);
  const Result<Duration> after = parse_duration(rest);
  if (!after || rest.starts_with('+') || rest.starts_with('-')) {
    return bad(text, "is not a time after the beginning: write +2, +2.5s or +1min");
  }
  return Moment{{}, {}, *after};
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

std::string counted(std::uint64_t number, std::string_view singular, std::string_view plural) {
  return fmt::format("{} {}", number, number == 1 ? singular : plural);
}

Result<std::uint64_t> parse_bytes(std::string_view text, std::uint64_t min) {
  static constexpr std::pair<std::string_view, double> kUnits[] = {
      {"KiB", 1ULL << 10}, {"MiB", 1ULL << 20}, {"GiB", 1ULL << 30}, {"TiB", 1ULL << 40}, {"", 1}};
  constexpr double kMax = 0x1p62;
  for (const auto& [unit, factor] : kUnits) {
    if (!text.ends_with(unit)) continue;
    const Result<double> number = parse_real(text.substr(0, text.size() - unit.size()));
    if (!number || *number * factor > kMax || *number * factor < static_cast<double>(min)) break;
    return static_cast<std::uint64_t>(*number * factor);
  }
  return bad(text, fmt::format("is not a size of at least {} bytes, as 500MiB: a number alone or "
                               "with KiB, MiB, GiB or TiB",
                               min));
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
