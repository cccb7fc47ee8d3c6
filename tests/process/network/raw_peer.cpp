// SPDX-License-Identifier: Apache-2.0
#include "tests/process/network/raw_peer.hpp"

#include <arpa/inet.h>
#include <google/protobuf/io/coded_stream.h>
#include <google/protobuf/io/zero_copy_stream_impl_lite.h>
#include <gtest/gtest.h>
#include <netinet/in.h>
#include <sys/socket.h>

#include <fstream>

namespace dssm::test {
namespace {

using google::protobuf::io::CodedInputStream;
using google::protobuf::io::CodedOutputStream;

constexpr std::size_t kMaxLengthBytes = 5;  // of a varint of 32 bits

sockaddr_in socket_address(const std::string& address, int port) {
  sockaddr_in out{};
  out.sin_family = AF_INET;
  out.sin_port = htons(static_cast<std::uint16_t>(port));
  EXPECT_EQ(::inet_pton(AF_INET, address.c_str(), &out.sin_addr), 1) << address;
  return out;
}

UniqueFd tcp_socket() { return UniqueFd(::socket(AF_INET, SOCK_STREAM | SOCK_CLOEXEC, 0)); }

// The first frame of `input`, if it is complete, and its end.
std::optional<net::Frame> first_frame(const std::string& input, std::size_t& end) {
  const auto* bytes = reinterpret_cast<const std::uint8_t*>(input.data());
  CodedInputStream in(bytes, static_cast<int>(input.size()));
  std::uint32_t length = 0;
  if (!in.ReadVarint32(&length)) {
    EXPECT_LT(input.size(), kMaxLengthBytes) << "an invalid length of a frame";
    return {};
  }
  const auto begin = static_cast<std::size_t>(in.CurrentPosition());
  if (input.size() - begin < length) return {};
  end = begin + length;
  net::Frame frame;
  EXPECT_TRUE(frame.ParseFromArray(bytes + begin, static_cast<int>(length)));
  return frame;
}

}  // namespace

RawPeer::RawPeer(const std::string& address, int port) : RawPeer(tcp_socket()) {
  const sockaddr_in to = socket_address(address, port);
  if (::connect(socket_.get(), reinterpret_cast<const sockaddr*>(&to), sizeof to) != 0) {
    socket_.reset();
  }
}

RawPeer::RawPeer(UniqueFd socket) : socket_(std::move(socket)) {
  const timeval patience{kPatienceSeconds, 0};
  ::setsockopt(socket_.get(), SOL_SOCKET, SO_RCVTIMEO, &patience, sizeof patience);
  ::setsockopt(socket_.get(), SOL_SOCKET, SO_SNDTIMEO, &patience, sizeof patience);
}

void RawPeer::send(const net::Frame& frame) {
  std::string bytes;
  {
    google::protobuf::io::StringOutputStream stream(&bytes);
    CodedOutputStream out(&stream);
    out.WriteVarint32(static_cast<std::uint32_t>(frame.ByteSizeLong()));
    frame.SerializeToCodedStream(&out);
  }  // `bytes` is complete after both are destroyed
  send_bytes(bytes);
}

void RawPeer::send_bytes(std::string_view bytes) {
  while (!bytes.empty() && is_open()) {
    const ssize_t n = ::send(socket_.get(), bytes.data(), bytes.size(), MSG_NOSIGNAL);
    if (n < 0) {
      EXPECT_NE(errno, EAGAIN) << "dssmd neither receives nor closes the connection";
      socket_.reset();
    } else {
      bytes.remove_prefix(static_cast<std::size_t>(n));
    }
  }
}

std::optional<net::Frame> RawPeer::receive() {
  for (;;) {
    std::size_t end = 0;
    if (std::optional<net::Frame> frame = first_frame(input_, end)) {
      input_.erase(0, end);
      return frame;
    }
    if (!is_open()) return {};
    char buffer[65536];
    const ssize_t n = ::recv(socket_.get(), buffer, sizeof buffer, 0);
    EXPECT_FALSE(n < 0 && errno == EAGAIN) << "dssmd neither sends nor closes the connection";
    if (n > 0) {
      input_.append(buffer, static_cast<std::size_t>(n));
    } else {
      socket_.reset();
    }
  }
}

std::optional<net::Frame> RawPeer::await_end() {
  std::optional<net::Frame> last;
  while (std::optional<net::Frame> frame = receive()) last = std::move(frame);
  return last;
}

std::optional<net::Frame> RawPeer::greet(const std::vector<std::string>& features) {
  send(hello_frame(1, features));
  std::optional<net::Frame> answer = receive();
  if (answer && answer->has_hello()) return {};
  return answer;
}

net::Frame hello_frame(std::uint32_t protocol_version, const std::vector<std::string>& features) {
  net::Frame frame;
  proto::Hello& hello = *frame.mutable_hello();
  hello.set_protocol_version(protocol_version);
  hello.set_host("raw");
  hello.set_host_id(std::string(16, 'r'));
  hello.set_instance_id(1);
  hello.set_program("raw peer");
  hello.set_version("0.0.0");
  // Its clock is this PC's.
  std::getline(std::ifstream("/proc/sys/kernel/random/boot_id"),
               *hello.mutable_clock()->mutable_boot_id());
  for (const std::string& feature : features) hello.add_features(feature);
  return frame;
}

net::Frame open_frame(std::uint64_t serial, const std::string& stream) {
  net::Frame frame;
  frame.set_serial(serial);
  frame.mutable_open()->mutable_id()->set_name(stream);
  return frame;
}

net::Frame subscribe_from_oldest_frame(std::uint64_t serial) {
  net::Frame frame;
  frame.set_serial(serial);
  frame.mutable_subscribe()->set_from_oldest(true);
  return frame;
}

UniqueFd listen_at(const std::string& address, int port) {
  UniqueFd listener = tcp_socket();
  const sockaddr_in at = socket_address(address, port);
  EXPECT_EQ(::bind(listener.get(), reinterpret_cast<const sockaddr*>(&at), sizeof at), 0);
  EXPECT_EQ(::listen(listener.get(), 16), 0);
  return listener;
}

RawPeer accept_peer(const UniqueFd& listener) {
  return RawPeer(UniqueFd(::accept4(listener.get(), nullptr, nullptr, SOCK_CLOEXEC)));
}

}  // namespace dssm::test
