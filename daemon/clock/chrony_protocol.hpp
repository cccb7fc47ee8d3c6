// SPDX-License-Identifier: Apache-2.0
//
// chronyd's command and monitoring protocol (version 6, UDP port 323), as far as it takes to ask
// for "tracking". No I/O. Layouts after candm.h of chrony 4.3; all numbers are big-endian.
//
// Why not `chronyc -c tracking`, which asks the same question: once a second it would start a
// process, which a sandbox had better not allow; its output comes through a pipe, to be parsed, and
// rounded to the nearest nanosecond instead of upwards; and it takes seconds to find that there is
// no chronyd. Here it is one datagram each way, and ECONNREFUSED at once.
//
// Anybody may ask for tracking from this PC (`cmdallow` concerns others), without a key.
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

// The length of a reply, and of a request, too, or chronyd refuses it: nobody shall make it send
// more than was sent.
inline constexpr std::size_t kTrackingBytes = 104;

std::array<std::byte, kTrackingBytes> tracking_request(std::uint32_t sequence);

// Whether a datagram may answer the request of that number: others are not worth a word.
bool answers_untrusted(std::span<const std::byte> datagram, std::uint32_t sequence);

// Reads a datagram that does.
//   fails  protocol (another version, length or kind of reply), no_permission and system (chronyd
//          says that it will not or cannot), with what to do
Result<TrackingReply> tracking_untrusted(std::span<const std::byte> datagram);

// A number of chronyd's in seconds: 2^(exponent - 25) * coefficient, of 7 and 25 bits, both signed.
// chronyd rounds to that by up to one unit of the coefficient.
//   returns  the nanoseconds that are as far from zero as what chronyd rounded may have been;
//            what is more than a Duration holds becomes the most that it does
Duration seconds_untrusted(std::uint32_t number) noexcept;

}  // namespace dssm::daemon
