// SPDX-License-Identifier: Apache-2.0
#include "tests/support/network_peer.hpp"

#include <gtest/gtest.h>
#include <poll.h>
#include <sys/socket.h>

#include <cstring>

#include "core/clock/clock_page.hpp"
#include "core/wire/address.hpp"
#include "core/wire/tcp.hpp"

namespace dssm::test {

NetworkPeer::NetworkPeer(UniqueFd socket) : socket_(std::move(socket)) {
  const timeval timeout{kNetworkPeerSeconds, 0};
  ::setsockopt(socket_.get(), SOL_SOCKET, SO_RCVTIMEO, &timeout, sizeof timeout);
  ::setsockopt(socket_.get(), SOL_SOCKET, SO_SNDTIMEO, &timeout, sizeof timeout);
}

NetworkPeer::NetworkPeer(const std::string& address)
    : NetworkPeer([&] {
        const wire::Address parsed = wire::Address::parse(address).value();
        const wire::SocketAddress to = wire::resolve_number(parsed).at(0);
        UniqueFd socket(::socket(to.storage.ss_family, SOCK_STREAM | SOCK_CLOEXEC, 0));
        if (::connect(socket.get(), to.get(), to.length) != 0) socket.reset();
        return socket;
      }()) {}

NetworkPeer NetworkPeer::greeted(const std::string& address, bool torn) {
  NetworkPeer peer(address);
  EXPECT_TRUE(peer.is_open()) << address << ": " << std::strerror(errno);
  const std::optional<net::Frame> instead = peer.greet(torn);
  EXPECT_FALSE(instead) << instead->failure().message();
  EXPECT_TRUE(peer.is_open());
  return peer;
}

void NetworkPeer::send(const net::Frame& frame) { send_bytes(wire::encode_frame(frame)); }

void NetworkPeer::send_bytes(std::string_view bytes) {
  while (!bytes.empty() && is_open()) {
    const ssize_t sent = ::send(socket_.get(), bytes.data(), bytes.size(), MSG_NOSIGNAL);
    if (sent < 0) {
      EXPECT_NE(errno, EAGAIN) << "the other end neither receives nor closes the connection";
      // What it sent before, such as a final failure, can still be received.
      ended_ = true;
      return;
    }
    bytes.remove_prefix(static_cast<std::size_t>(sent));
  }
}

void NetworkPeer::send_sample(const SampleInfo& info, std::span<const std::byte> payload,
                              std::uint64_t serial) {
  const Bytes bytes = sample_bytes(info, payload, serial);
  send_bytes({reinterpret_cast<const char*>(bytes.data()), bytes.size()});
}

std::optional<net::Frame> NetworkPeer::try_receive() {
  for (;;) {
    if (std::optional<net::Frame> frame = input_.next()) return frame;
    if (!socket_) return {};
    const std::span<std::byte> space = input_.space();
    const ssize_t got = ::recv(socket_.get(), space.data(), space.size(), 0);
    EXPECT_FALSE(got < 0 && errno == EAGAIN)
        << "the other end neither sends nor closes the connection";
    if (got <= 0) {
      ended_ = true;
      return {};
    }
    input_.commit(static_cast<std::size_t>(got));
  }
}

net::Frame NetworkPeer::receive() {
  std::optional<net::Frame> frame = try_receive();
  EXPECT_TRUE(frame) << "the connection has ended";
  return frame ? *std::move(frame) : net::Frame();
}

std::optional<net::Frame> NetworkPeer::await_end() {
  std::optional<net::Frame> last;
  while (std::optional<net::Frame> frame = try_receive()) last = std::move(frame);
  return last;
}

std::optional<net::Frame> NetworkPeer::greet(bool torn) {
  send(client_hello_frame(wire::kNetworkProtocolVersion, torn));
  std::optional<net::Frame> answer = try_receive();
  if (!answer || !answer->has_hello()) return answer;
  server_ = answer->hello();
  return {};
}

net::Frame NetworkPeer::ask(net::Frame request) {
  request.set_serial(++serial_);
  send(request);
  while (std::optional<net::Frame> answer = try_receive()) {
    if (answer->serial() == request.serial() && !answer->torn()) return *std::move(answer);
  }
  return {};
}

proto::Opened NetworkPeer::open(const std::string& name) {
  const net::Frame answer = ask(open_frame(name));
  EXPECT_TRUE(answer.has_opened()) << answer.failure().message();
  return answer.opened();
}

proto::Opened NetworkPeer::create(const std::string& name, std::uint64_t payload_bytes,
                                  std::uint64_t depth) {
  const net::Frame answer = ask(create_frame(name, payload_bytes, depth));
  EXPECT_TRUE(answer.has_opened()) << answer.failure().message();
  return answer.opened();
}

std::string NetworkPeer::final_failure() {
  std::string message;
  while (const std::optional<net::Frame> frame = try_receive()) {
    if (frame->has_failure() && frame->serial() == 0) message = frame->failure().message();
  }
  return message;
}

void NetworkPeer::answer_hello() {
  const std::optional<net::Frame> hello = try_receive();
  EXPECT_TRUE(!hello || hello->has_hello());
  wire::Greeting greeting = without_features(greeting_of("fake"));
  greeting.instance_id = 1;  // the same dssmd at each connection
  send(hello_frame(greeting));
}

net::Frame NetworkPeer::answer_open(std::uint64_t payload_bytes, std::uint64_t incarnation,
                                    const std::string& type_name) {
  answer_hello();
  net::Frame request = try_receive().value_or(net::Frame());
  net::Frame answer = answer_to(request);
  proto::Stream& stream = *answer.mutable_opened()->mutable_stream();
  *stream.mutable_id() = request.has_create() ? request.create().id() : request.open().id();
  stream.mutable_id()->set_host("fake");
  stream.mutable_type()->set_name(type_name);
  stream.mutable_type()->set_payload_bytes(payload_bytes);
  stream.mutable_type()->set_alignment_bytes(1);
  stream.set_depth(16);
  stream.set_cycle_ns(1'000'000);
  stream.set_incarnation(incarnation);
  send(answer);
  return request;
}

net::Frame NetworkPeer::answer_subscribe(std::int64_t first, std::uint64_t incarnation) {
  net::Frame request = try_receive().value_or(net::Frame());
  send(subscribed_frame(request, incarnation, first));
  return request;
}

void NetworkPeer::refuse(Errc code, const std::string& text) {
  send(failure_frame(code, text, try_receive().value_or(net::Frame())));
}

net::Frame client_hello_frame(std::uint32_t protocol_version, bool torn) {
  wire::Greeting greeting = greeting_of("peer", "test");
  greeting.instance_id = 1;
  if (!torn) greeting = without_features(std::move(greeting));
  net::Frame frame = hello_frame(greeting, protocol_version);
  frame.mutable_hello()->mutable_clock()->set_boot_id(clock::boot_id());
  return frame;
}

ScriptedDaemon::ScriptedDaemon(Script script, const std::string& address) {
  const auto at = wire::Address::parse(address, wire::kDefaultPort, true).value();
  listener_ = wire::listen_tcp(wire::resolve_number(at).at(0)).value();
  address_ = wire::local_address(listener_.get())->str();
  thread_ = std::thread([this, script = std::move(script)] { serve(script); });
}

void ScriptedDaemon::serve(const Script& script) {
  for (int number = 0;; ++number) {
    pollfd ready{listener_.get(), POLLIN, 0};
    while (::poll(&ready, 1, -1) < 0) continue;
    UniqueFd socket(::accept4(listener_.get(), nullptr, nullptr, SOCK_CLOEXEC));
    if (stop_ || !socket) return;
    wire::set_channel_options(socket.get());
    connected_ = socket.get();
    NetworkPeer peer(std::move(socket));
    if (!stop_) script(peer, number);
    connected_ = -1;
    peer.close();
    ++ended_;
  }
}

ScriptedDaemon::~ScriptedDaemon() {
  stop_ = true;
  ::shutdown(listener_.get(), SHUT_RDWR);  // ends the wait for a connection
  if (const int socket = connected_; socket >= 0) ::shutdown(socket, SHUT_RDWR);
  thread_.join();
}

}  // namespace dssm::test
