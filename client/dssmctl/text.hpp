// SPDX-License-Identifier: Apache-2.0
//
// Between numbers and what a person types or reads. Everything printed is plain ASCII: bytes from
// streams' names and payloads are escaped, so that no stream can play tricks on a terminal, and a
// column is as wide as it has bytes.
#pragma once

#include <cstddef>
#include <cstdint>
#include <dssm/result.hpp>
#include <dssm/time.hpp>
#include <span>
#include <string>
#include <string_view>
#include <vector>

namespace dssm::ctl {

// `bytes` with control and non-ASCII bytes as \n, \t or \xNN, and backslash as \\ : what bash reads
// back in $'...'.
std::string escaped(std::string_view bytes);

// The same for a message that is to be one line; backslashes stay, it may have been escaped before.
std::string escaped_message(std::string_view message);

// `texts`, escaped, with commas between them: "a, b".
std::string list_text(const std::vector<std::string>& texts);

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

// "512 bytes", "1.50 MiB"; "1.50 MiB/s". Everywhere in units of 1024.
std::string bytes_text(std::uint64_t bytes);
std::string byte_rate_text(double bytes_per_second);

// "00ff10"; a hex dump in lines of 16 bytes with offsets and printable characters, each line after
// `indent`.
std::string hex_text(std::span<const std::byte> bytes);
std::string hex_dump(std::span<const std::byte> bytes, std::string_view indent);

// Reads seconds, "1.5", "-0.25", "1e-3", as nanoseconds; exact unless there is an exponent. Digits
// finer than a nanosecond are cut off. Fails with invalid_argument.
Result<Duration> parse_seconds(std::string_view text);

// Reads a whole number from `min` to `max`. Fails with invalid_argument.
Result<std::uint64_t> parse_whole(std::string_view text, std::uint64_t min, std::uint64_t max);

// Reads a finite number. Fails with invalid_argument.
Result<double> parse_real(std::string_view text);

// a - b and a + b, at the ends of the range where it would overflow: stamps may be anything.
Duration saturating_sub(Time a, Time b);
Time saturating_add(Time a, Duration b);

}  // namespace dssm::ctl
