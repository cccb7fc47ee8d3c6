// SPDX-License-Identifier: Apache-2.0
//
// The values of configuration keys, from text. Each failure is a reason alone ("'5x' is no
// number"), to which the caller adds file, line and key.
#pragma once

#include <sys/types.h>

#include <cstdint>
#include <dssm/result.hpp>
#include <dssm/time.hpp>
#include <string_view>

#include "core/clock/clock_bound.hpp"
#include "daemon/base/log.hpp"
#include "daemon/service/clock_policies.hpp"

namespace dssm::daemon {

// A whole number from `least` to `most`.
Result<std::uint64_t> parse_count(std::string_view text, std::uint64_t least, std::uint64_t most);

// Bytes: "1048576", "512 KiB", "64 MiB", "2 GiB", "1 TiB", or "50%" of the machine's memory.
Result<std::uint64_t> parse_bytes(std::string_view text, std::uint64_t least, std::uint64_t most);

// "0 ms", "1500 us", "500 ms", "2 s"; the unit must be there.
Result<Duration> parse_duration(std::string_view text, Duration least, Duration most);

// "enforce", "mark", "off".
Result<ClockPolicy> parse_clock_policy(std::string_view text);

// How far two clocks may be apart: 10 us to 10 s.
Result<Duration> parse_clock_limit(std::string_view text);

// "STREAM=POLICY", or "STREAM=POLICY LIMIT": "gps=off", "camera*=mark 5 ms".
Result<ClockPolicies::Exception> parse_clock_exception(std::string_view text);

// How far a clock runs away: "50 ppm"; 1 to 1000. In billionths.
Result<clock::PartsPerBillion> parse_drift(std::string_view text);

// File permissions in octal, "0660"; only the nine ordinary bits, and the owner's write bit is set.
Result<mode_t> parse_mode(std::string_view text);

// The number of the group `name`, which must exist.
Result<gid_t> parse_group(std::string_view name);

// true, false
Result<bool> parse_boolean(std::string_view text);

// The name of a network interface, or a pattern for such names as in fnmatch(3): 1 to 63 bytes
// without blanks and '/', at most 15 of them when it is no pattern.
Result<std::string> parse_interface(std::string_view text);

// error, warning, notice, info, debug
Result<LogLevel> parse_log_level(std::string_view text);

// 0 when the system does not say.
std::uint64_t memory_of_the_machine() noexcept;

}  // namespace dssm::daemon
