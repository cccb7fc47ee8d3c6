// SPDX-License-Identifier: Apache-2.0
//
// What mDNS carries: the DNS-SD service instances of DSSM and their TXT records (RFC 6763), as
// documented in docs/discovery.md, one per stream, "lidar:0@pc2", and one per host, "pc2"; and what
// is found by them (FoundHost), between the finder (Mdns) and its observer (Peers).
#pragma once

#include <cstdint>
#include <dssm/host_state.hpp>
#include <dssm/result.hpp>
#include <dssm/stream.hpp>
#include <optional>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

#include "core/wire/address.hpp"
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

// Keys and values, in order; an empty value is a key alone, without '='. Values are bytes.
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

// What another host announces; only records of hosts are used.
//   fails  protocol: another txtvers, values that are missing, wrong or out of their limits
Result<ServiceRecord> service_record_untrusted(const TxtRecord& txt);

// A dssmd that was found: not this one, as far as is known. A value.
struct FoundHost {
  wire::HostId id{};  // this host's own: of a PC that was copied from this one, or the like
  std::string name;   // "pc2"; two hosts may have the same one
  std::uint32_t protocol_version = 0;
  bool closed = false;  // it listens on its own loopback only: not to be reached
  // Where it may be reached, best first; numbers only, link-local ones with their interface
  // ("[fe80::1%eth0]:13776"). Empty when `closed` and on another PC.
  std::vector<wire::Address> addresses;

  friend bool operator==(const FoundHost&, const FoundHost&) = default;
};

// Called in the thread of the event loop that the finder was given.
class HostFinderObserver {
 public:
  virtual void on_host_found(const FoundHost& host) = 0;  // or something of it has changed
  virtual void on_host_lost(const wire::HostId& id) = 0;  // mDNS does not know it any more
  virtual void on_mdns_state(const MdnsInfo&) {}

 protected:
  ~HostFinderObserver() = default;
};

}  // namespace dssm::daemon
