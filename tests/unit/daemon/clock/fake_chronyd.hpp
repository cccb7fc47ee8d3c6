// SPDX-License-Identifier: Apache-2.0
//
// A chronyd that answers as the test says, at a port of its own on loopback.
#pragma once

#include <gtest/gtest.h>
#include <netinet/in.h>
#include <sys/socket.h>

#include <array>
#include <cmath>
#include <functional>
#include <initializer_list>
#include <span>
#include <utility>
#include <vector>

#include "core/base/unique_fd.hpp"
#include "core/wire/tcp.hpp"
#include "daemon/base/event_loop.hpp"
#include "daemon/clock/chrony_protocol.hpp"

namespace dssm::daemon {

using Datagram = std::vector<std::byte>;

// Where the parts of a reply are.
inline constexpr std::size_t kReplyVersion = 0, kReplyType = 1, kReplyCommand = 4, kReplyKind = 6,
                             kReplyStatus = 8, kReplySequence = 16, kReplyReferenceId = 28,
                             kReplyAddress = 32, kReplyFamily = 48, kReplyStratum = 52,
                             kReplyLeap = 54, kReplySeconds = 56, kReplyNanoseconds = 64,
                             kReplyCorrection = 68, kReplyFrequency = 80, kReplyDelay = 92,
                             kReplyDispersion = 96, kReplyInterval = 100;

template <class Number>
void put_number(Datagram& to, std::size_t at, Number number) {
  for (std::size_t i = 0; i < sizeof number; ++i) {
    to.at(at + i) = static_cast<std::byte>(number >> 8 * (sizeof number - 1 - i));
  }
}

inline std::uint32_t number_at(std::span<const std::byte> from, std::size_t at) {
  std::uint32_t number = 0;
  for (std::size_t i = at; i < at + 4; ++i) {
    number = number << 8 | std::to_integer<std::uint32_t>(from[i]);
  }
  return number;
}

inline std::uint32_t chrony_float(std::int32_t coefficient, int exponent) {
  return static_cast<std::uint32_t>(exponent) << 25 |
         (static_cast<std::uint32_t>(coefficient) & 0x1ffffffU);
}

// A number of seconds as chronyd writes it.
inline std::uint32_t chrony_float(double seconds) {
  int exponent = 0;
  const double part = std::frexp(seconds, &exponent);
  return chrony_float(static_cast<std::int32_t>(std::round(part * (1 << 24))), exponent + 1);
}

// What chronyd 4.3 answered to request 0x11223344, while it followed one on 127.0.0.1. chronyc said
// at that time: stratum 11, last measured at 1795323571.059992969, clock off by -0.3 us, root delay
// 3.629 us, root dispersion 1.9 to 2.5 us, update interval 1.0 s.
inline Datagram real_reply() {
  constexpr std::string_view kHex =
      "060200000021000500000000000000001122334400000000000000007f000001"
      "7f00000100000000000000000000000000010000000b0000000000006b0276b3"
      "03936b89d962dc11dd38d8d1da840816016cacf1fd5a3bd102d84b1ddef389bf"
      "dea4aec60480a242";
  Datagram bytes;
  for (std::size_t i = 0; i < kHex.size(); i += 2) {
    bytes.push_back(static_cast<std::byte>(std::stoi(std::string(kHex.substr(i, 2)), nullptr, 16)));
  }
  return bytes;
}

inline Datagram reply_of(const clock::Tracking& tracking) {
  Datagram reply = real_reply();
  const auto seconds = [](Duration d) {
    return chrony_float(std::chrono::duration<double>(d).count());
  };
  put_number(reply, kReplyReferenceId, tracking.reference_id);
  put_number(reply, kReplyAddress, tracking.reference_id);
  put_number(reply, kReplyStratum, tracking.stratum);
  put_number(reply, kReplyLeap, tracking.leap);
  put_number(reply, kReplySeconds,
             static_cast<std::uint64_t>(to_ns(tracking.updated) / 1'000'000'000));
  put_number(reply, kReplyNanoseconds,
             static_cast<std::uint32_t>(to_ns(tracking.updated) % 1'000'000'000));
  put_number(reply, kReplyCorrection, seconds(-tracking.offset));
  put_number(reply, kReplyFrequency, chrony_float(static_cast<double>(-tracking.rate_ppb) / 1000));
  put_number(reply, kReplyDelay, seconds(tracking.root.delay));
  put_number(reply, kReplyDispersion, seconds(tracking.root.dispersion));
  put_number(reply, kReplyInterval, seconds(tracking.update_interval));
  return reply;
}

class FakeChronyd {
 public:
  struct Request {
    Datagram bytes;
    sockaddr_in from{};
    std::uint32_t sequence() const { return number_at(bytes, 8); }
  };
  using OnRequest = std::function<void(const Request&)>;

  FakeChronyd(const EventLoop& loop, OnRequest on_request)
      : loop_(loop), on_request_(std::move(on_request)) {
    start();
  }

  const wire::SocketAddress& address() const { return address_; }

  // At the same port as before, if it was stopped.
  void start() {
    socket_.reset(::socket(AF_INET, SOCK_DGRAM | SOCK_NONBLOCK | SOCK_CLOEXEC, 0));
    if (address_.length == 0) {
      address_ = wire::resolve_number(wire::Address::parse("127.0.0.1:0", 0, true).value()).at(0);
    }
    ASSERT_EQ(::bind(socket_.get(), address_.get(), address_.length), 0);
    address_ = wire::local_address(socket_.get()).value();
    readable_ = EventSource::readable(loop_, socket_.get(), [this] { take(); });
    readable_.enable();
  }
  void stop() {
    readable_ = {};
    socket_.reset();
  }

  void send(const Request& to, const Datagram& bytes) {
    ::sendto(socket_.get(), bytes.data(), bytes.size(), 0,
             reinterpret_cast<const sockaddr*>(&to.from), sizeof to.from);
  }
  void answer(const Request& request, Datagram reply) {
    put_number(reply, kReplySequence, request.sequence());
    send(request, reply);
  }

 private:
  void take() {
    Request request;
    request.bytes.resize(1024);
    socklen_t length = sizeof request.from;
    const ssize_t size = ::recvfrom(socket_.get(), request.bytes.data(), request.bytes.size(), 0,
                                    reinterpret_cast<sockaddr*>(&request.from), &length);
    if (size < 0) return;  // an earlier answer was refused
    request.bytes.resize(static_cast<std::size_t>(size));
    on_request_(request);
  }

  const EventLoop& loop_;
  OnRequest on_request_;
  wire::SocketAddress address_;
  UniqueFd socket_;
  EventSource readable_;
};

}  // namespace dssm::daemon
