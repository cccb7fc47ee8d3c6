// SPDX-License-Identifier: Apache-2.0
//
// Addresses as people write them. An address that is clearly wrong is refused here with a helpful
// message; getaddrinfo() would fail with "Name or service not known" after some seconds, or, for
// "10.1", return an address that was not meant.
#include "core/wire/address.hpp"

#include <arpa/inet.h>
#include <net/if.h>
#include <netdb.h>
#include <netinet/in.h>

#include <algorithm>
#include <cerrno>
#include <charconv>
#include <cstring>
#include <memory>

#include "core/base/try.hpp"

namespace dssm::wire {
namespace {

constexpr std::size_t kMaxHostNameBytes = 253;  // RFC 1035 2.3.4, without the final dot
constexpr std::array<std::uint8_t, 12> kMappedIpv4{0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0xff, 0xff};

Error invalid(std::string_view text, std::string_view why) {
  return Error{Errc::invalid_argument, "address '" + std::string(text) + "': " + std::string(why)};
}

bool is_digit(char c) noexcept { return c >= '0' && c <= '9'; }

bool is_ipv4(std::string_view host) {
  in_addr number{};
  return ::inet_pton(AF_INET, std::string(host).c_str(), &number) == 1;
}

// With or without a zone: "fe80::1%eth0".
bool is_ipv6(std::string_view host) {
  const auto percent = host.find('%');
  in6_addr number{};
  if (::inet_pton(AF_INET6, std::string(host.substr(0, percent)).c_str(), &number) != 1) {
    return false;
  }
  if (percent == host.npos) return true;
  const std::string_view zone = host.substr(percent + 1);
  return !zone.empty() && zone.size() < IF_NAMESIZE &&
         std::all_of(zone.begin(), zone.end(), [](char c) { return c > ' ' && c != '/'; });
}

// Only digits and dots: meant as a number, and never a host's name.
bool looks_like_ipv4(std::string_view host) {
  return std::all_of(host.begin(), host.end(), [](char c) { return is_digit(c) || c == '.'; });
}

bool is_name(std::string_view host) {
  return host.size() <= kMaxHostNameBytes && host.front() != '-' && host.front() != '.' &&
         std::all_of(host.begin(), host.end(), [](char c) {
           return is_digit(c) || (c >= 'a' && c <= 'z') || (c >= 'A' && c <= 'Z') || c == '-' ||
                  c == '.' || c == '_';
         });
}

// `text` is the whole address, for messages.
Result<std::uint16_t> parse_port(std::string_view text, std::string_view port, bool zero_allowed) {
  std::uint16_t number = 0;
  const auto [end, error] = std::from_chars(port.data(), port.data() + port.size(), number);
  if (error != std::errc() || end != port.data() + port.size()) {
    return invalid(text, "'" + std::string(port) +
                             "' is not a port; write HOST:PORT with a port from 1 to 65535");
  }
  if (number == 0 && !zero_allowed) {
    return invalid(text, "port 0 cannot be connected to; take one from 1 to 65535");
  }
  return number;
}

SocketAddress socket_address(const addrinfo& info) {
  SocketAddress address;
  std::memcpy(&address.storage, info.ai_addr, info.ai_addrlen);
  address.length = info.ai_addrlen;
  return address;
}

// getaddrinfo with `flags`; returns its status.
int look_up(const Address& address, int flags, std::vector<SocketAddress>& found) {
  addrinfo hints{};
  hints.ai_socktype = SOCK_STREAM;
  hints.ai_flags = flags | AI_NUMERICSERV;
  addrinfo* list = nullptr;
  const int status =
      ::getaddrinfo(address.host.c_str(), std::to_string(address.port).c_str(), &hints, &list);
  if (status != 0) return status;
  const std::unique_ptr<addrinfo, decltype(&::freeaddrinfo)> owner(list, &::freeaddrinfo);
  for (const addrinfo* info = list; info; info = info->ai_next) {
    if (info->ai_family == AF_INET || info->ai_family == AF_INET6) {
      found.push_back(socket_address(*info));
    }
  }
  return 0;
}

}  // namespace

Result<Address> Address::parse(std::string_view text, std::uint16_t default_port,
                               bool port_0_allowed) {
  Address address{"", default_port};
  if (text.starts_with('[')) {
    const auto bracket = text.find(']');
    if (bracket == text.npos) return invalid(text, "the ']' is missing; write [IPV6]:PORT");
    address.host = text.substr(1, bracket - 1);
    if (!is_ipv6(address.host)) {
      return invalid(text, "'" + address.host + "' in brackets is not an IPv6 number");
    }
    const std::string_view rest = text.substr(bracket + 1);
    if (rest.empty()) return address;
    if (rest.front() != ':') return invalid(text, "after ']' comes :PORT or nothing");
    address.port = DSSM_TRY(parse_port(text, rest.substr(1), port_0_allowed));
    return address;
  }
  if (is_ipv6(text)) {
    address.host = text;
    return address;
  }
  const auto colon = text.find(':');
  address.host = text.substr(0, colon);
  if (text.find(':', colon + 1) != text.npos && colon != text.npos) {
    return invalid(text, "this is not an IPv6 number; write one with a port as [IPV6]:PORT");
  }
  if (address.host.empty()) return invalid(text, "the host is missing; write HOST or HOST:PORT");
  if (looks_like_ipv4(address.host)) {
    if (!is_ipv4(address.host)) {
      return invalid(text, "'" + address.host + "' is not an IPv4 number; write it like 10.0.0.2");
    }
  } else if (!is_name(address.host)) {
    return invalid(text, "'" + address.host +
                             "' is not a host name; these are letters, digits, '-', '_' and '.'");
  }
  if (colon == text.npos) return address;
  address.port = DSSM_TRY(parse_port(text, text.substr(colon + 1), port_0_allowed));
  return address;
}

std::string Address::str() const {
  const bool brackets = host.find(':') != host.npos;
  return (brackets ? "[" + host + "]" : host) + ":" + std::to_string(port);
}

std::string SocketAddress::str() const {
  char host[NI_MAXHOST] = {}, port[NI_MAXSERV] = {};
  if (::getnameinfo(get(), length, host, sizeof host, port, sizeof port,
                    NI_NUMERICHOST | NI_NUMERICSERV) != 0) {
    return "an unknown address";
  }
  const bool brackets = storage.ss_family == AF_INET6;
  return (brackets ? "[" + std::string(host) + "]" : std::string(host)) + ":" + port;
}

bool SocketAddress::is_loopback() const noexcept {
  if (storage.ss_family == AF_INET) {
    sockaddr_in ipv4{};
    std::memcpy(&ipv4, &storage, sizeof ipv4);
    return ntohl(ipv4.sin_addr.s_addr) >> 24 == IN_LOOPBACKNET;
  }
  if (storage.ss_family == AF_INET6) {
    sockaddr_in6 ipv6{};
    std::memcpy(&ipv6, &storage, sizeof ipv6);
    if (IN6_IS_ADDR_V4MAPPED(&ipv6.sin6_addr)) return ipv6.sin6_addr.s6_addr[12] == IN_LOOPBACKNET;
    return IN6_IS_ADDR_LOOPBACK(&ipv6.sin6_addr);
  }
  return false;
}

IpAddress IpAddress::of_ipv4(const void* four_bytes) {
  IpAddress address;
  std::copy(kMappedIpv4.begin(), kMappedIpv4.end(), address.bytes.begin());
  std::memcpy(&address.bytes[kMappedIpv4.size()], four_bytes, 4);
  return address;
}

std::optional<IpAddress> IpAddress::of(const SocketAddress& address) {
  switch (address.storage.ss_family) {
    case AF_INET:
      return of_ipv4(&reinterpret_cast<const sockaddr_in*>(&address.storage)->sin_addr);
    case AF_INET6: {
      IpAddress ipv6;
      std::memcpy(ipv6.bytes.data(),
                  &reinterpret_cast<const sockaddr_in6*>(&address.storage)->sin6_addr,
                  ipv6.bytes.size());
      return ipv6;
    }
    default:
      return {};
  }
}

bool IpAddress::is_ipv4() const noexcept {
  return std::equal(kMappedIpv4.begin(), kMappedIpv4.end(), bytes.begin());
}

IpAddress IpAddress::network() const {
  IpAddress network = *this;
  if (!is_ipv4()) std::fill(network.bytes.begin() + 8, network.bytes.end(), std::uint8_t{});
  return network;
}

std::string IpAddress::str() const {
  std::array<char, INET6_ADDRSTRLEN> text{};
  const bool ipv4 = is_ipv4();
  ::inet_ntop(ipv4 ? AF_INET : AF_INET6, &bytes[ipv4 ? kMappedIpv4.size() : 0], text.data(),
              text.size());
  return text.data();
}

Result<std::vector<SocketAddress>> resolve(const Address& address) {
  std::vector<SocketAddress> found;
  const std::string what = "look up host '" + address.host + "'";
  errno = 0;
  const int status = look_up(address, 0, found);
  if (status == EAI_SYSTEM) return os_error(what);
  if (status == EAI_AGAIN) {
    return Error{Errc::system, what +
                                   ": the name server does not answer; write the host's IP "
                                   "number instead, or put the name into /etc/hosts"};
  }
  if (status != 0 || found.empty()) {
    return Error{Errc::not_found, what + ": there is no such host (" +
                                      std::string(::gai_strerror(status)) +
                                      "); check the spelling, or put it into /etc/hosts"};
  }
  return found;
}

std::vector<SocketAddress> resolve_number(const Address& address) {
  std::vector<SocketAddress> found;
  if (is_ipv4(address.host) || is_ipv6(address.host)) look_up(address, AI_NUMERICHOST, found);
  return found;
}

}  // namespace dssm::wire
