// SPDX-License-Identifier: Apache-2.0
#include "tests/process/pconnector/fake_daemon.hpp"

#include <gtest/gtest.h>
#include <poll.h>
#include <sys/socket.h>

#include "core/wire/network_protocol.hpp"
#include "core/wire/tcp.hpp"

namespace dssm::test {

std::optional<net::Frame> FakePeer::take() {
  for (;;) {
    auto message = input_.next();
    EXPECT_TRUE(message);
    if (*message) {
      net::Frame frame;
      EXPECT_TRUE(frame.ParseFromArray((*message)->data(), static_cast<int>((*message)->size())));
      return frame;
    }
    const auto space = input_.space();
    const ssize_t count = ::recv(socket_, space.data(), space.size(), 0);
    if (count <= 0) return std::nullopt;
    input_.commit(static_cast<std::size_t>(count));
  }
}

void FakePeer::send_bytes(const std::string& bytes) {
  for (std::size_t sent = 0; sent < bytes.size();) {
    const ssize_t count = ::send(socket_, bytes.data() + sent, bytes.size() - sent, MSG_NOSIGNAL);
    if (count <= 0) return;
    sent += static_cast<std::size_t>(count);
  }
}

void FakePeer::send(const net::Frame& frame) { send_bytes(wire::encode_frame(frame)); }

void FakePeer::greet() {
  const auto hello = take();
  EXPECT_TRUE(!hello || hello->has_hello());
  wire::Greeting self;
  self.host = "fake";
  self.host_id = wire::host_id_for("fake");
  self.instance_id = 1;
  self.program = "dssmd";
  self.version = "0";
  net::Frame answer;
  wire::to_message(self, *answer.mutable_hello());
  send(answer);
}

net::Frame FakePeer::open(std::uint64_t payload_bytes, std::uint64_t incarnation,
                          const std::string& type_name) {
  greet();
  net::Frame request = take().value_or(net::Frame());
  net::Frame answer;
  answer.set_serial(request.serial());
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

net::Frame FakePeer::subscribe(std::int64_t first, std::uint64_t incarnation) {
  net::Frame request = take().value_or(net::Frame());
  net::Frame answer;
  answer.set_serial(request.serial());
  answer.mutable_subscribed()->set_incarnation(incarnation);
  answer.mutable_subscribed()->set_first_tid(first);
  answer.mutable_subscribed()->set_newest(first - 1);
  send(answer);
  return request;
}

void FakePeer::send_sample(std::int64_t tid, const std::string& payload, std::uint64_t serial,
                           bool torn) {
  net::Frame frame;
  frame.set_serial(serial);
  frame.mutable_sample()->set_tid(tid);
  frame.mutable_sample()->set_time_ns(tid * 10);
  frame.mutable_sample()->set_clock_error_ns(7);
  frame.set_payload(payload);
  frame.set_torn(torn);
  send(frame);
}

void FakePeer::wait_for_end() {
  while (take()) {
  }
}

FakeDaemon::FakeDaemon(std::function<void(FakePeer&, int)> script) {
  const auto any = wire::Address::parse("127.0.0.1:0", wire::kDefaultPort, true).value();
  listener_ = wire::listen_tcp(wire::resolve_number(any).at(0)).value();
  address_ = wire::local_address(listener_.get())->str();
  thread_ = std::thread([this, script = std::move(script)] { serve(script); });
}

void FakeDaemon::serve(const std::function<void(FakePeer&, int)>& script) {
  for (int number = 0;; ++number) {
    pollfd ready{listener_.get(), POLLIN, 0};
    while (::poll(&ready, 1, -1) < 0) continue;
    UniqueFd socket(::accept4(listener_.get(), nullptr, nullptr, SOCK_CLOEXEC));
    if (stop_ || !socket) return;
    wire::set_channel_options(socket.get());
    connected_ = socket.get();
    if (!stop_) {
      FakePeer peer(socket.get());
      script(peer, number);
    }
    connected_ = -1;
    socket.reset();
    ++ended_;
  }
}

void FakeDaemon::hang_up() {
  if (const int socket = connected_; socket >= 0) ::shutdown(socket, SHUT_RDWR);
}

FakeDaemon::~FakeDaemon() {
  stop_ = true;
  ::shutdown(listener_.get(), SHUT_RDWR);  // ends accept()
  hang_up();
  thread_.join();
}

}  // namespace dssm::test
