// SPDX-License-Identifier: Apache-2.0
#include "daemon/clock/chrony_protocol.hpp"

#include <arpa/inet.h>
#include <netinet/in.h>

#include <algorithm>
#include <bit>
#include <cstring>
#include <limits>

namespace dssm::daemon {
namespace {

constexpr std::uint8_t kCommandVersion = 6, kRequest = 1, kReply = 2;
constexpr std::uint16_t kTrackingCommand = 33, kTrackingReport = 5;

// The head of a request: version, type, 2 reserved bytes, command, number of the attempt, sequence.
constexpr std::size_t kRequestCommand = 4, kRequestSequence = 8;
// The head of a reply: version, type, 2 reserved bytes, command, kind of report, status, ...
constexpr std::size_t kCommand = 4, kReport = 6, kStatus = 8, kSequence = 16, kHead = 28;
// The report, in the order of its parts.
constexpr std::size_t kReferenceId = 28, kAddress = 32, kFamily = 48, kStratum = 52, kLeap = 54,
                      kSecondsHigh = 56, kSecondsLow = 60, kNanoseconds = 64, kCorrection = 68,
                      kFrequency = 80, kRootDelay = 92, kRootDispersion = 96, kUpdateInterval = 100;
static_assert(kUpdateInterval + 4 == kTrackingBytes);

// Families of addresses. The last one is the number of a source without an address.
constexpr std::uint16_t kNoAddress = 0, kIpv4 = 1, kIpv6 = 2, kNumber = 3;
// The upper half of the seconds of a chronyd that counts them in 32 bits.
constexpr std::uint32_t kNoHighSeconds = 0x7fffffff;

constexpr std::int64_t kBillion = 1'000'000'000;
constexpr int kCoefficientBits = 25, kExponentBits = 7;

std::uint8_t byte_at(std::span<const std::byte> from, std::size_t at) {
  return static_cast<std::uint8_t>(from[at]);
}
std::uint16_t short_at(std::span<const std::byte> from, std::size_t at) {
  return static_cast<std::uint16_t>(byte_at(from, at) << 8 | byte_at(from, at + 1));
}
std::uint32_t word_at(std::span<const std::byte> from, std::size_t at) {
  return static_cast<std::uint32_t>(short_at(from, at)) << 16 | short_at(from, at + 2);
}

template <class Number>
void put(std::span<std::byte> to, std::size_t at, Number number) {
  for (std::size_t i = sizeof number; i-- > 0; number = static_cast<Number>(number >> 8)) {
    to[at + i] = static_cast<std::byte>(number);
  }
}

// The `bits` lowest bits of a number, as one with a sign.
std::int32_t with_sign(std::uint32_t number, int bits) noexcept {
  return static_cast<std::int32_t>(number << (32 - bits)) >> (32 - bits);
}

Error refusal_of(std::uint16_t status) {
  const std::string what = "it refuses to answer: ";
  switch (status) {
    case 2:   // STT_UNAUTH
    case 10:  // STT_NOHOSTACCESS
      return {Errc::no_permission,
              what + "this PC may not ask (`cmdallow`, `cmddeny` in chrony.conf)"};
    case 3:  // STT_INVALID
      return {Errc::protocol, what + "it does not know the question; is it chrony 3 or newer?"};
    case 6:  // STT_NOTENABLED
      return {Errc::system, what + "not enabled; was it built without NTP?"};
    case 18:  // STT_BADPKTVERSION
    case 19:  // STT_BADPKTLENGTH
      return {Errc::protocol,
              what + "it speaks another version of the protocol; is it chrony 3 or newer?"};
    default:
      return {Errc::system, what + "status " + std::to_string(status) +
                                "; does `chronyc tracking` work, and what does chronyd log?"};
  }
}

Error not_understood(const std::string& what, int theirs, int ours) {
  return {Errc::protocol, "it answers with " + what + " " + std::to_string(theirs) +
                              " instead of " + std::to_string(ours) +
                              "; is it chronyd, and of a version that this one knows?"};
}

// Saturates: a time that far from now is not valid in any case.
Time time_at(std::uint32_t high, std::uint32_t low, std::uint32_t nanoseconds) {
  constexpr std::uint64_t kMaxSeconds = std::numeric_limits<std::int64_t>::max() / kBillion - 1;
  const std::uint64_t seconds =
      static_cast<std::uint64_t>(high == kNoHighSeconds ? 0 : high) << 32 | low;
  return time_from_ns(static_cast<std::int64_t>(std::min(seconds, kMaxSeconds)) * kBillion +
                      nanoseconds);
}

}  // namespace

std::array<std::byte, kTrackingBytes> tracking_request(std::uint32_t sequence) {
  std::array<std::byte, kTrackingBytes> request{};
  put(request, 0, kCommandVersion);
  put(request, 1, kRequest);
  put(request, kRequestCommand, kTrackingCommand);
  put(request, kRequestSequence, sequence);
  return request;
}

bool answers_untrusted(std::span<const std::byte> datagram, std::uint32_t sequence) {
  return datagram.size() >= kHead && byte_at(datagram, 1) == kReply &&
         word_at(datagram, kSequence) == sequence;
}

Result<TrackingReply> tracking_untrusted(std::span<const std::byte> datagram) {
  if (datagram.size() < kHead) {
    return not_understood("bytes:", static_cast<int>(datagram.size()), kTrackingBytes);
  }
  if (byte_at(datagram, 0) != kCommandVersion) {
    return not_understood("version", byte_at(datagram, 0), kCommandVersion);
  }
  if (byte_at(datagram, 1) != kReply) {
    return not_understood("a message of type", byte_at(datagram, 1), kReply);
  }
  if (short_at(datagram, kCommand) != kTrackingCommand) {
    return not_understood("a reply to command", short_at(datagram, kCommand), kTrackingCommand);
  }
  if (const std::uint16_t status = short_at(datagram, kStatus)) return refusal_of(status);
  if (short_at(datagram, kReport) != kTrackingReport) {
    return not_understood("a report of kind", short_at(datagram, kReport), kTrackingReport);
  }
  if (datagram.size() != kTrackingBytes) {
    return not_understood("bytes:", static_cast<int>(datagram.size()), kTrackingBytes);
  }
  const std::uint32_t nanoseconds = word_at(datagram, kNanoseconds);
  if (nanoseconds >= kBillion) {
    return Error{Errc::protocol, "it answers with a second of " + std::to_string(nanoseconds) +
                                     " nanoseconds; is it chronyd?"};
  }

  TrackingReply reply;
  switch (const std::uint16_t family = short_at(datagram, kFamily)) {
    case kIpv4:
      reply.source = wire::IpAddress::of_ipv4(&datagram[kAddress]);
      break;
    case kIpv6:
      reply.source.emplace();
      std::memcpy(reply.source->bytes.data(), &datagram[kAddress], reply.source->bytes.size());
      break;
    case kNoAddress:
    case kNumber:
      break;
    default:
      return not_understood("an address of family", family, kIpv4);
  }
  clock::Tracking& tracking = reply.tracking;
  tracking.reference_id = word_at(datagram, kReferenceId);
  tracking.stratum = short_at(datagram, kStratum);
  tracking.leap = short_at(datagram, kLeap);
  tracking.updated =
      time_at(word_at(datagram, kSecondsHigh), word_at(datagram, kSecondsLow), nanoseconds);
  tracking.update_interval = seconds_untrusted(word_at(datagram, kUpdateInterval));
  // The correction is what is added to this clock to get chronyd's time: the opposite sign.
  tracking.offset = -seconds_untrusted(word_at(datagram, kCorrection));
  // The frequency is that of this clock against chronyd's, if chronyd did not correct it: the
  // opposite sign. It is in ppm; as seconds it is 10^6 times too large for ns per second.
  tracking.rate_ppb = -seconds_untrusted(word_at(datagram, kFrequency)).count() / 1'000'000;
  tracking.root = {seconds_untrusted(word_at(datagram, kRootDispersion)),
                   seconds_untrusted(word_at(datagram, kRootDelay))};
  return reply;
}

Duration seconds_untrusted(std::uint32_t number) noexcept {
  const int exponent = with_sign(number >> kCoefficientBits, kExponentBits) - kCoefficientBits;
  const std::int64_t coefficient = with_sign(number, kCoefficientBits);
  // chronyd sends 0 for 0 and for what is too small for its format, less than 2^-64 s.
  if (coefficient == 0) return {};
  // Less than 2^55: a coefficient and one unit more, in nanoseconds.
  const std::int64_t size = ((coefficient < 0 ? -coefficient : coefficient) + 1) * kBillion;
  constexpr std::int64_t kMaxNs = std::numeric_limits<std::int64_t>::max();
  std::int64_t nanoseconds = 1;  // of anything smaller
  if (exponent >= 0) {
    nanoseconds = size > kMaxNs >> exponent ? kMaxNs : size << exponent;
  } else if (exponent > -62) {
    nanoseconds = (size + (std::int64_t{1} << -exponent) - 1) >> -exponent;
  }
  return Duration(coefficient < 0 ? -nanoseconds : nanoseconds);
}

}  // namespace dssm::daemon
