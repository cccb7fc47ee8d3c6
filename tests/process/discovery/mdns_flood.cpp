// SPDX-License-Identifier: Apache-2.0
#include "tests/process/discovery/mdns_flood.hpp"

#include <arpa/inet.h>
#include <netinet/in.h>
#include <sys/socket.h>
#include <time.h>

#include <array>
#include <cstdio>
#include <initializer_list>
#include <string_view>

#include "core/base/check.hpp"

namespace dssm::test {
namespace {

constexpr std::uint16_t kPtr = 12, kTxt = 16, kSrv = 33, kA = 1;
constexpr int kHostsPerPacket = 3;  // below an Ethernet frame's size

std::string u16(unsigned value) {
  return {static_cast<char>(value >> 8), static_cast<char>(value & 0xff)};
}

std::string name(std::initializer_list<std::string_view> labels) {
  std::string data;
  for (const std::string_view label : labels) {
    data += static_cast<char>(label.size());
    data += label;
  }
  return data + '\0';
}

std::string record(const std::string& owner, std::uint16_t type, std::uint32_t ttl_s,
                   const std::string& data) {
  return owner + u16(type) + u16(1) + u16(ttl_s >> 16) + u16(ttl_s & 0xffff) +
         u16(static_cast<unsigned>(data.size())) + data;
}

std::string host_records(int number, std::uint32_t ttl_s) {
  const std::string label = "flood" + std::to_string(number);
  const std::string instance = name({label, "_dssm", "_tcp", "local"});
  const std::string target = name({label, "local"});
  std::array<char, 48> hid;
  std::snprintf(hid.data(), hid.size(), "hid=%032x", number + 1000);
  std::string txt;
  for (const std::string& text : {std::string("txtvers=1"), "host=" + label,
                                  std::string(hid.data()), std::string("proto=1")}) {
    txt += static_cast<char>(text.size());
    txt += text;
  }
  return record(name({"_host:", "_sub", "_dssm", "_tcp", "local"}), kPtr, ttl_s, instance) +
         record(instance, kSrv, ttl_s, u16(0) + u16(0) + u16(9) + target) +
         record(instance, kTxt, ttl_s, txt) +
         record(target, kA, ttl_s, std::string("\x0a\x4d\x00\xfa", 4));
}

}  // namespace

MdnsFlood::MdnsFlood(const std::string& interface_address)
    : socket_(::socket(AF_INET, SOCK_DGRAM | SOCK_CLOEXEC, 0)) {
  DSSM_CHECK(socket_);
  const int yes = 1, ttl = 255;
  in_addr interface {};
  DSSM_CHECK(::inet_pton(AF_INET, interface_address.c_str(), &interface) == 1);
  const int fd = socket_.get();
  DSSM_CHECK(!::setsockopt(fd, SOL_SOCKET, SO_REUSEADDR, &yes, sizeof yes));
  DSSM_CHECK(!::setsockopt(fd, SOL_SOCKET, SO_REUSEPORT, &yes, sizeof yes));
  DSSM_CHECK(!::setsockopt(fd, IPPROTO_IP, IP_MULTICAST_TTL, &ttl, sizeof ttl));
  DSSM_CHECK(!::setsockopt(fd, IPPROTO_IP, IP_MULTICAST_IF, &interface, sizeof interface));
  // Answers that do not come from this port are not listened to (RFC 6762 section 6).
  const sockaddr_in from{AF_INET, htons(5353), interface, {}};
  DSSM_CHECK(!::bind(fd, reinterpret_cast<const sockaddr*>(&from), sizeof from));
}

void MdnsFlood::announce_hosts(int count, std::uint32_t ttl_s) const {
  sockaddr_in group{AF_INET, htons(5353), {}, {}};
  ::inet_pton(AF_INET, "224.0.0.251", &group.sin_addr);
  for (int first = 0; first < count; first += kHostsPerPacket) {
    std::string packet = u16(0) + u16(0x8400) + u16(0) + u16(4 * kHostsPerPacket) + u16(0) + u16(0);
    for (int i = 0; i < kHostsPerPacket; ++i) packet += host_records(first + i, ttl_s);
    DSSM_CHECK(::sendto(socket_.get(), packet.data(), packet.size(), 0,
                        reinterpret_cast<const sockaddr*>(&group),
                        sizeof group) == static_cast<ssize_t>(packet.size()));
    // No faster than the receivers' sockets take them, so that most of them arrive.
    const timespec pause{0, 200'000};
    ::nanosleep(&pause, nullptr);
  }
}

}  // namespace dssm::test
