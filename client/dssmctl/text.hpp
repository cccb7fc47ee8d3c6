// SPDX-License-Identifier: Apache-2.0
//
// Between numbers and what a person types or reads. Bytes from streams' names and payloads are
// escaped unless they are printable ASCII, or printable UTF-8 where the locale has that: so no
// stream can play tricks on a terminal.
#pragma once

#include <cstddef>
#include <cstdint>
#include <dssm/result.hpp>
#include <dssm/time.hpp>
#include <optional>
#include <span>
#include <string>
#include <string_view>
#include <vector>

namespace dssm::ctl {

// From now on UTF-8 is printed as it is if the process's locale (LC_CTYPE) has it.
void use_locale();

// `bytes` with all that is not printable as \n, \t or \xNN, and backslash as \\ : what bash reads
// back in $'...'. Not printable are also invisible characters and those that change the direction.
std::string escaped(std::string_view bytes);

// The same for a message that is to be one line; backslashes stay, it may have been escaped before.
std::string escaped_message(std::string_view message);

// The same in double quotes.
std::string double_quoted(std::string_view text);

// How many columns of a terminal escaped text takes.
std::size_t columns_of(std::string_view text);

// Escaped text, cut to so many columns at most, and then with three dots at its end.
std::string shortened(std::string_view text, std::size_t columns);

// The first `at_most` of `texts`, escaped: "a, b" or "a, b, and 3 more".
std::string list_text(const std::vector<std::string>& texts, std::size_t at_most = SIZE_MAX);

// `text`, or "-" when it is empty.
std::string or_dash(const std::string& text);

// A duration with three digits and its unit: "1.25 ms", "2h05m". For people only.
std::string duration_text(Duration d);

// The same for nanoseconds that are not whole.
std::string ns_text(double ns);

// A bound on a clock's or stamp's error, as duration_text(), or "unknown".
std::string bound_text(Duration bound);

// `bound` as a part of `limit`, 12 characters: "[###       ]". A '#' is a tenth, rounded up; beyond
// the limit it ends with '>': "[##########>". Unknown: "-".
std::string bar_text(Duration bound, Duration limit);

// Nanoseconds as exact seconds: "-1.500000000".
std::string seconds_text(std::int64_t ns);

// `value` with `decimals` digits after the point.
std::string fixed_text(double value, int decimals);

// "1 sample", "2 samples".
std::string counted(std::uint64_t number, std::string_view singular, std::string_view plural);

// "512 bytes", "1.50 MiB"; "1.50 MiB/s". Everywhere in units of 1024.
std::string bytes_text(std::uint64_t bytes);
std::string byte_rate_text(double bytes_per_second);

// "00ff10"; a hex dump in lines of 16 bytes with offsets and printable characters, each line after
// `indent`.
std::string hex_text(std::span<const std::byte> bytes);
std::string hex_dump(std::span<const std::byte> bytes, std::string_view indent);

// A moment as ISO 8601 in UTC: "2026-11-27T08:00:00.123456789Z".
std::string iso_text(Time time);

// A moment as all verbs print it: seconds since 1970, or as iso_text().
inline std::string time_text(Time time, bool iso) {
  return iso ? iso_text(time) : seconds_text(to_ns(time));
}

// Reads a duration: seconds, "1.5", "-0.25", "1e-3", or with a unit (ns, us, ms, s, min, h, d):
// "250ms". As nanoseconds, exact unless there is an exponent; digits finer than a nanosecond are
// cut off. Fails with invalid_argument.
Result<Duration> parse_duration(std::string_view text);

// What a person gives as a time.
struct Moment {
  Time time{};
  // Negative or 0: so long before another moment, which depends on the option; `time` is
  // meaningless.
  std::optional<Duration> back = {};
  // Of a recording: so long after its beginning; `time` is meaningless.
  std::optional<Duration> after_start = {};

  friend bool operator==(const Moment&, const Moment&) = default;
};

// Reads seconds since 1970 ("1700000000.25"), ISO 8601 ("2026-11-27", "2026-11-27T08:00",
// "2026-11-27 08:00:00.5Z", "2026-11-27T08:00:00+09:00"; without an offset in the local time zone),
// "now", or with a minus sign how long before ("-3s", "-1.5"). Fails with invalid_argument.
Result<Moment> parse_moment(std::string_view text, Time now);

// The same of a recording: also "+2s", so long after its beginning.
Result<Moment> parse_recorded_moment(std::string_view text, Time now);

// Reads a whole number from `min` to `max`. Fails with invalid_argument.
Result<std::uint64_t> parse_whole(std::string_view text, std::uint64_t min, std::uint64_t max);

// Reads a number of bytes, "1048576", or with a unit (KiB, MiB, GiB, TiB): "1.5GiB". At least
// `min`. Fails with invalid_argument.
Result<std::uint64_t> parse_bytes(std::string_view text, std::uint64_t min);

// Reads a finite number. Fails with invalid_argument.
Result<double> parse_real(std::string_view text);

// a - b and a + b, at the ends of the range where it would overflow: stamps may be anything.
Duration saturating_sub(Time a, Time b);
Time saturating_add(Time a, Duration b);

}  // namespace dssm::ctl
