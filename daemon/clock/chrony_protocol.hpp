// SPDX-License-Identifier: Apache-2.0
//
// chronyd's command and monitoring protocol (version 6, UDP port 323), as far as it takes to ask
// for "tracking". No I/O. Layouts after candm.h of chrony 4.3; all numbers are big-endian.
//
// Why not `chronyc -c tracking`, which asks the same question: it would be a process started once a
// second, which a sandbox should not allow; its output would have to be parsed, and is rounded to
// the nearest nanosecond instead of upwards; and without a chronyd it takes seconds to fail. Here
// it is one datagram each way, and ECONNREFUSED at once.
//
// Any program of this PC may ask for tracking, without a key (`cmdallow` concerns other PCs).
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <dssm/result.hpp>
#include <optional>
#include <span>
#include <string>

#include "core/wire/address.hpp"
#include "daemon/clock/clock_estimator.hpp"

namespace dssm::daemon {

// What chronyd answers.
struct TrackingReply {
  clock::Tracking tracking;
  std::optional<wire::IpAddress> source;  // nullopt: it follows no host, or a clock of this PC
};

// The length of a reply, and of a request: chronyd refuses a shorter one, so that its reply is
// never longer than the request.
inline constexpr std::size_t kTrackingBytes = 104;

std::array<std::byte, kTrackingBytes> tracking_request(std::uint32_t sequence);

// Whether a datagram may answer the request of that number; others are ignored.
bool answers_untrusted(std::span<const std::byte> datagram, std::uint32_t sequence);

// Reads a datagram that does.
//   fails  protocol (another version, length or kind of reply), no_permission and system (chronyd
//          refuses, or cannot answer), with what to do
Result<TrackingReply> tracking_untrusted(std::span<const std::byte> datagram);

// A number of chronyd's in seconds: 2^(exponent - 25) * coefficient, of 7 and 25 bits, both signed.
// chronyd rounds to that by up to one unit of the coefficient.
//   returns  nanoseconds, rounded away from zero by as much as chronyd may have rounded towards it;
//            beyond what a Duration holds: its greatest or least value
Duration seconds_untrusted(std::uint32_t number) noexcept;

}  // namespace dssm::daemon
