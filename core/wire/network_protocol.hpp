// SPDX-License-Identifier: Apache-2.0
//
// Shared by both ends of the network protocol: version, limits, and the greeting.
#pragma once

#include <array>
#include <cstdint>
#include <dssm/result.hpp>
#include <dssm/time.hpp>
#include <memory>
#include <string>
#include <vector>

#include "core/wire/clock_report.hpp"
#include "core/wire/host_id.hpp"
#include "core/wire/messages.hpp"
#include "network.pb.h"

namespace dssm::wire {

inline constexpr std::uint32_t kNetworkProtocolVersion = 1;
inline constexpr std::size_t kMaxNetworkFrameBytes =
    kMaxPropertyBytes + (64U << 10);  // without a payload
inline constexpr std::size_t kMaxFeatures = 32;
inline constexpr std::size_t kMaxFeatureBytes = 63;
inline constexpr std::string_view kFeatureTorn = "torn";  // network.proto, Frame.torn
inline constexpr std::string_view kFeatureNewestFirst = "newest_first";  // Subscribe
inline constexpr std::string_view kFeatureClock = "clock";  // network.proto, Pong as an event
inline constexpr std::string_view kFeatureUsers = "users";  // network.proto, SetUsers

inline constexpr std::size_t kMaxChannelUsers = 64;  // that SetUsers names

// Heartbeats of control connections, and how long no bytes may arrive until the peer counts as dead
// (design: within 3 s).
inline constexpr Duration kHeartbeat = std::chrono::seconds(1);
inline constexpr Duration kPeerTimeout = std::chrono::milliseconds(2800);
// For the first Hello of a connection to be complete.
inline constexpr Duration kHelloTimeout = std::chrono::seconds(3);

struct OwnCredentials;  // tls_credentials.hpp

// Who is at one end of a connection. A value.
struct Greeting {
  std::string host;  // host's name, checked: 1 to 31 letters, digits and '-'
  HostId host_id{};
  std::uint64_t instance_id = 0;  // random; differs between two runs of one program
  std::string program;            // "dssmd", "mapper"
  std::string version;
  std::int32_t pid = 0;  // of a program; 0: not known, or a dssmd
  std::vector<std::string> features;
  // What it reports of its clock; nullptr: nothing. Our own is kept up to date by FleetClock, and
  // all copies of our greeting share it.
  std::shared_ptr<const ClockReport> clock;
  // Of our own greeting: what proves it. All copies share it; a reload replaces what it holds.
  // nullptr, or holding nullptr: connections are not encrypted.
  std::shared_ptr<const OwnCredentials> credentials;

  bool has_feature(std::string_view feature) const noexcept;
  bool is_dssmd() const noexcept { return program == "dssmd"; }
  std::string str() const;  // "'mapper' on host 'pc3'", "dssmd of host 'pc2'"
};

void to_message(const Greeting& greeting, proto::Hello& out);

// Takes over the other side's Hello.
//   fails  protocol: another version (the message names both versions, both sides and what to do),
//          or values out of their limits
//   who    for the message: "dssmd at '10.0.0.2:13776'", "the program at '10.0.0.3:40000'"
Result<Greeting> greeting_untrusted(const proto::Hello& message, const std::string& who);

// The same at the connecting end, from the first frame that the other side sends: its Hello, or the
// Failure by which it refuses the connection.
//   fails  also: the other side's reason
Result<Greeting> server_greeting_untrusted(const net::Frame& frame, const std::string& who);

// Why this side cannot communicate with `who`, which has the version `theirs`.
//   software  "0.3.0"; empty: not known
Error other_protocol_version(const std::string& who, std::uint32_t theirs,
                             const std::string& software = {});

// Random and never 0.
std::uint64_t random_number();

// Adds the report of our own clock as of now; nothing when nothing is known.
void send_clock(const Greeting& self, proto::ClockReport& out);

// The report in a Pong that was sent as an event.
std::shared_ptr<const ClockReport> clock_report_untrusted(const net::Pong& pong);

}  // namespace dssm::wire
