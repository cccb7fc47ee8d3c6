// SPDX-License-Identifier: Apache-2.0
//
// The address of a dssmd: as people write it, and as the system takes it.
#pragma once

#include <sys/socket.h>

#include <array>
#include <cstdint>
#include <dssm/result.hpp>
#include <optional>
#include <string>
#include <string_view>
#include <vector>

namespace dssm::wire {

inline constexpr std::uint16_t kDefaultPort = 13776;

// "pc2:13776", "10.0.0.2:13776", "[fe80::1%eth0]:13776". A value.
struct Address {
  std::string host;  // name or number, without brackets
  std::uint16_t port = kDefaultPort;

  // Reads HOST, HOST:PORT, [IPV6] or [IPV6]:PORT; a bare IPv6 number needs no brackets when it has
  // no port. Port 0 is allowed only with `port_0_allowed` (to listen on any free port).
  //   fails  invalid_argument, saying what is wrong
  static Result<Address> parse(std::string_view text, std::uint16_t default_port = kDefaultPort,
                               bool port_0_allowed = false);
  std::string str() const;  // with port, and brackets where they are needed

  friend bool operator==(const Address&, const Address&) = default;
};

// One address of the operating system.
struct SocketAddress {
  sockaddr_storage storage{};
  socklen_t length = 0;

  const sockaddr* get() const noexcept { return reinterpret_cast<const sockaddr*>(&storage); }
  std::string str() const;            // "10.0.0.2:13776", "[::1]:13776"
  bool is_loopback() const noexcept;  // 127.0.0.0/8, ::1, ::ffff:127.0.0.0/104
};

// An address without port, in 16 bytes: IPv4 as ::ffff:10.0.0.1, so that equal addresses have equal
// bytes. A value.
struct IpAddress {
  std::array<std::uint8_t, 16> bytes{};

  static IpAddress of_ipv4(const void* four_bytes);
  // nullopt: it is neither IPv4 nor IPv6.
  static std::optional<IpAddress> of(const SocketAddress& address);
  bool is_ipv4() const noexcept;
  // Of an IPv6 address its /64, of which each device may use any address; IPv4: the address itself.
  IpAddress network() const;
  std::string str() const;  // "10.0.0.1", "fd77::1"

  friend bool operator==(const IpAddress&, const IpAddress&) = default;
};

// The addresses of `address`: at once for numbers; names are resolved (getaddrinfo), which may
// take seconds, so dssmd does it in a thread of its own. In the system's order of preference.
//   fails  not_found (no such host), system
Result<std::vector<SocketAddress>> resolve(const Address& address);

// Without looking anything up: the addresses when `address.host` is a number, else an empty list.
std::vector<SocketAddress> resolve_number(const Address& address);

}  // namespace dssm::wire
