// SPDX-License-Identifier: Apache-2.0
//
// The DNS-SD service instances of DSSM and their TXT records (RFC 6763), as documented in
// docs/discovery.md: one per stream, "lidar:0@pc2", and one per host, "pc2". Pure functions.
#pragma once

#include <cstdint>
#include <dssm/result.hpp>
#include <dssm/stream.hpp>
#include <optional>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

#include "core/wire/network_protocol.hpp"

namespace dssm::daemon {

inline constexpr std::string_view kServiceType = "_dssm._tcp";
// The subtype that only hosts have, so that one browser finds hosts and not thousands of streams.
// No stream can be called so.
inline constexpr std::string_view kHostSubtype = "_host:._sub._dssm._tcp";
// One DNS label. Streams whose names do not fit are refused when they are created
// (StreamId::check).
inline constexpr std::size_t kMaxInstanceBytes = 63;
static_assert(kMaxInstanceBytes == kMaxFullNameBytes);

// Of what others announce; ours stay far below (docs/discovery.md "Sizes").
inline constexpr std::size_t kMaxTxtBytes = 1300;

// Keys and values, in order; an empty value stands for a key alone, without '='. Values are bytes.
using TxtRecord = std::vector<std::pair<std::string, std::string>>;

// What is announced: a stream, or (without `stream`) the host itself.
struct ServiceRecord {
  wire::HostId host_id{};
  std::string host;
  std::uint32_t protocol_version = 0;
  bool closed = false;  // FoundHost::closed

  struct Stream {
    std::string name;
    std::int32_t id = 0;
    std::uint64_t payload_bytes = 0, depth = 0;
    Duration cycle{};
    std::string type;
    std::uint64_t type_hash = 0;
    std::uint64_t incarnation = 0;
    friend bool operator==(const Stream&, const Stream&) = default;
  };
  std::optional<Stream> stream;

  std::string instance() const;  // "lidar:0@pc2", "pc2"
  std::string subtype() const;   // "_lidar._sub._dssm._tcp", escaped; kHostSubtype
  TxtRecord txt() const;

  friend bool operator==(const ServiceRecord&, const ServiceRecord&) = default;
};

// Tells types apart that have one name; equal for equal types, on every host and in every version
// (docs/discovery.md "Records").
std::uint64_t type_hash(const TypeInfo& type);

// What another host announces; only hosts' records are of use to us.
//   fails  protocol: another txtvers, values that are missing, wrong or out of their limits
Result<ServiceRecord> service_record_untrusted(const TxtRecord& txt);

}  // namespace dssm::daemon
