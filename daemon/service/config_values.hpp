// SPDX-License-Identifier: Apache-2.0
//
// The values of configuration keys: from text, and what those of clock_policy, clock_limit and
// clock_streams mean. Each failure is a reason alone ("'5x' is not a number"), to which the caller
// adds file, line and key.
#pragma once

#include <sys/types.h>

#include <cstdint>
#include <dssm/clock_status.hpp>
#include <dssm/result.hpp>
#include <dssm/stream.hpp>
#include <dssm/time.hpp>
#include <optional>
#include <string>
#include <string_view>
#include <vector>

#include "core/clock/clock_bound.hpp"
#include "core/wire/transport.hpp"
#include "daemon/base/log.hpp"

namespace dssm::daemon {

// Whether `pattern`, as in fnmatch(3), is of the stream's name or of "NAME:ID".
bool names_stream(const std::string& pattern, const StreamId& id);

// Which clocks are good enough for which streams: the configuration keys clock_policy, clock_limit
// and clock_streams.
struct ClockDemand {
  ClockPolicy policy = ClockPolicy::enforce;
  Duration limit =
      std::chrono::microseconds(1500);  // the greatest clock error that reads by time accept

  friend bool operator==(const ClockDemand& a, const ClockDemand& b) = default;
};

struct ClockPolicies {
  // Another demand for some streams. The first that matches counts.
  struct Exception {
    std::string pattern;  // as in names_stream()
    ClockPolicy policy = ClockPolicy::enforce;
    Duration limit{};  // 0: the general one

    friend bool operator==(const Exception& a, const Exception& b) = default;
  };

  ClockDemand general;
  std::vector<Exception> exceptions;

  ClockDemand demand_for(const StreamId& id) const;

  friend bool operator==(const ClockPolicies& a, const ClockPolicies& b) = default;
};

// What mirrors ask of the owners of their streams: the configuration keys mirror_history and
// mirror_streams.
struct MirrorDemand {
  bool history_at_once = false;  // else when a program reads it
  double max_rate_hz = 0;        // 0: all samples
  Duration max_history{};        // that its ring holds; 0: as much as the owner's

  friend bool operator==(const MirrorDemand& a, const MirrorDemand& b) = default;
};

struct MirrorDemands {
  // Another demand for some streams. The first that matches counts.
  struct Exception {
    std::string pattern;                  // as in names_stream()
    std::optional<bool> history_at_once;  // nothing: as in general
    double max_rate_hz = 0;
    Duration max_history{};

    friend bool operator==(const Exception& a, const Exception& b) = default;
  };

  MirrorDemand general;
  std::vector<Exception> exceptions;

  MirrorDemand demand_for(const StreamId& id) const;

  friend bool operator==(const MirrorDemands& a, const MirrorDemands& b) = default;
};

// How samples of streams are sent to other hosts: the configuration key stream_priorities.
struct SendingDemand {
  wire::Priority priority = wire::Priority::normal;
  int history_percent = 100;  // of what the network carries, for history at most

  friend bool operator==(const SendingDemand& a, const SendingDemand& b) = default;
};

struct SendingDemands {
  struct Exception {
    std::string pattern;  // as in names_stream()
    SendingDemand demand;

    friend bool operator==(const Exception& a, const Exception& b) = default;
  };
  // Shorter samples are small ones, by default with a high priority: they take little, and wait
  // most for others.
  static constexpr std::uint64_t kSmallBytes = 16U << 10;

  std::vector<Exception> exceptions;

  SendingDemand demand_for(const StreamId& id, std::uint64_t payload_bytes) const;

  friend bool operator==(const SendingDemands& a, const SendingDemands& b) = default;
};

// "1%" to "100%"
Result<std::uint64_t> parse_percent(std::string_view text);

// A whole number from `min` to `max`.
Result<std::uint64_t> parse_count(std::string_view text, std::uint64_t min, std::uint64_t max);

// Bytes: "1048576", "512 KiB", "64 MiB", "2 GiB", "1 TiB", or "50%" of the machine's memory.
Result<std::uint64_t> parse_bytes(std::string_view text, std::uint64_t min, std::uint64_t max);

// "0 ms", "1500 us", "500 ms", "2 s"; the unit must be there.
Result<Duration> parse_duration(std::string_view text, Duration min, Duration max);

// "at_once": true, "when_read": false.
Result<bool> parse_mirror_history(std::string_view text);

// "enforce", "mark", "off".
Result<ClockPolicy> parse_clock_policy(std::string_view text);

// How far two clocks may be apart: 10 us to 10 s.
Result<Duration> parse_clock_limit(std::string_view text);

// "STREAM=POLICY", or "STREAM=POLICY LIMIT": "gps=off", "camera*=mark 5 ms".
Result<ClockPolicies::Exception> parse_clock_exception(std::string_view text);

// "STREAM=WHAT, WHAT": "map=at_once", "camera*=when_read, 10 Hz, 2 s".
Result<MirrorDemands::Exception> parse_mirror_exception(std::string_view text);

// "STREAM=PRIORITY", or "STREAM=PRIORITY SHARE": "encoder*=high", "camera*=low 30%".
Result<SendingDemands::Exception> parse_sending_exception(std::string_view text);

// The drift of a clock: "50 ppm"; 1 to 1000. In billionths.
Result<clock::PartsPerBillion> parse_drift(std::string_view text);

// File permissions in octal, "0660"; only the nine ordinary bits, and the owner's write bit is set.
Result<mode_t> parse_mode(std::string_view text);

// The number of the group or user `name`, which must exist.
Result<gid_t> parse_group(std::string_view name);
Result<uid_t> parse_user(std::string_view name);

// true, false
Result<bool> parse_boolean(std::string_view text);

// The name of a network interface, or a pattern for such names as in fnmatch(3): 1 to 63 bytes
// without blanks and '/', at most 15 of them when it is no pattern.
Result<std::string> parse_interface(std::string_view text);

// error, warning, notice, info, debug
Result<LogLevel> parse_log_level(std::string_view text);

// 0: not known.
std::uint64_t memory_of_the_machine() noexcept;

}  // namespace dssm::daemon
