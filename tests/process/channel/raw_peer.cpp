// SPDX-License-Identifier: Apache-2.0
#include "tests/process/channel/raw_peer.hpp"

#include <gtest/gtest.h>
#include <sys/socket.h>

#include <cstring>
#include <fstream>

#include "core/clock/clock_page.hpp"
#include "core/wire/address.hpp"
#include "core/wire/frame.hpp"
#include "core/wire/sample_frame.hpp"

namespace dssm::test {

RawPeer::RawPeer(const std::string& address, bool greet, bool torn) {
  const Result<wire::Address> parsed = wire::Address::parse(address);
  EXPECT_TRUE(parsed) << address;
  if (!parsed) return;
  const wire::SocketAddress number = wire::resolve_number(*parsed).at(0);
  socket_ = UniqueFd(::socket(number.storage.ss_family, SOCK_STREAM | SOCK_CLOEXEC, 0));
  const timeval patience{kPatienceSeconds, 0};
  ::setsockopt(socket_.get(), SOL_SOCKET, SO_RCVTIMEO, &patience, sizeof patience);
  ::setsockopt(socket_.get(), SOL_SOCKET, SO_SNDTIMEO, &patience, sizeof patience);
  EXPECT_EQ(::connect(socket_.get(), number.get(), number.length), 0)
      << address << ": " << std::strerror(errno);
  if (!greet) return;
  send(network_hello(wire::kNetworkProtocolVersion, torn));
  const Received hello = receive();
  EXPECT_TRUE(hello.frame.has_hello()) << hello.frame.failure().message();
  server_ = hello.frame.hello();
}

void RawPeer::send(const net::Frame& frame) { send_bytes(wire::encode_frame(frame)); }

void RawPeer::send_bytes(std::string_view bytes) {
  while (!bytes.empty()) {
    const ssize_t sent = ::send(socket_.get(), bytes.data(), bytes.size(), MSG_NOSIGNAL);
    // A dssmd that hangs up on us while we send is for receive() to notice.
    if (sent < 0) return;
    bytes.remove_prefix(static_cast<std::size_t>(sent));
  }
}

void RawPeer::send_sample(std::int64_t number, std::span<const std::byte> payload, Time time,
                          std::uint64_t serial) {
  std::array<std::byte, wire::kMaxSampleHeaderBytes> header;
  const std::size_t bytes = wire::encode_sample_header(header, serial, {number, time, Duration(5)},
                                                       payload.size(), wire::Trailer::none);
  std::string frame(reinterpret_cast<const char*>(header.data()), bytes);
  frame.append(reinterpret_cast<const char*>(payload.data()), payload.size());
  send_bytes(frame);
}

Received RawPeer::receive() {
  while (received_.empty()) {
    const std::span<const iovec> spaces = decoder_.spaces();
    msghdr message{};
    message.msg_iov = const_cast<iovec*>(spaces.data());
    message.msg_iovlen = spaces.size();
    const ssize_t got = ::recvmsg(socket_.get(), &message, 0);
    EXPECT_FALSE(got < 0 && errno == EAGAIN) << "dssmd does not answer";
    if (got <= 0) {
      Received end;
      end.ended = true;
      return end;
    }
    const Result<void> taken = decoder_.commit(static_cast<std::size_t>(got));
    EXPECT_TRUE(taken) << taken.error().message;
    if (!taken) break;
  }
  Received first = std::move(received_.front());
  received_.pop_front();
  return first;
}

Received RawPeer::ask(net::Frame request) {
  request.set_serial(++serial_);
  send(request);
  for (;;) {
    Received answer = receive();
    if (answer.ended || (answer.frame.serial() == request.serial() && !answer.torn)) return answer;
  }
}

std::string RawPeer::final_failure() {
  std::string words;
  for (;;) {
    const Received next = receive();
    if (next.ended) return words;
    if (next.frame.has_failure() && next.frame.serial() == 0)
      words = next.frame.failure().message();
  }
}

proto::Opened RawPeer::open(const std::string& name) {
  net::Frame request;
  request.mutable_open()->mutable_id()->set_name(name);
  const Received answer = ask(request);
  EXPECT_TRUE(answer.frame.has_opened()) << answer.frame.failure().message();
  decoder_.set_payload_bytes(answer.frame.opened().stream().type().payload_bytes());
  return answer.frame.opened();
}

proto::Opened RawPeer::create(const std::string& name, std::uint64_t payload_bytes,
                              std::uint64_t depth) {
  net::Frame request;
  proto::Create& create = *request.mutable_create();
  create.mutable_id()->set_name(name);
  create.mutable_type()->set_payload_bytes(payload_bytes);
  create.mutable_type()->set_alignment_bytes(8);
  create.set_depth(depth);
  create.set_cycle_ns(1'000'000);
  const Received answer = ask(request);
  EXPECT_TRUE(answer.frame.has_opened()) << answer.frame.failure().message();
  decoder_.set_payload_bytes(payload_bytes);
  return answer.frame.opened();
}

Result<void> RawPeer::on_sample_begin(const wire::IncomingSample& sample, std::byte*& out) {
  arriving_ = {};
  arriving_.frame.set_serial(sample.serial);
  arriving_.frame.mutable_sample()->set_tid(sample.info.tid);
  arriving_.frame.mutable_sample()->set_time_ns(to_ns(sample.info.time));
  arriving_.payload.resize(sample.payload_bytes);
  out = arriving_.payload.data();
  return {};
}

Result<void> RawPeer::on_sample_end(const wire::IncomingSample&, bool torn) {
  arriving_.torn = torn;
  received_.push_back(std::move(arriving_));
  return {};
}

Result<void> RawPeer::on_frame(net::Frame& frame) {
  Received received;
  received.frame = std::move(frame);
  received_.push_back(std::move(received));
  return {};
}

net::Frame network_hello(std::uint32_t version, bool torn) {
  wire::Greeting greeting;
  greeting.host = "elsewhere";
  greeting.host_id.fill(3);
  greeting.instance_id = 99;
  greeting.program = "raw";
  greeting.version = "test";
  if (torn) greeting.features.emplace_back(wire::kFeatureTorn);
  net::Frame frame;
  wire::to_message(greeting, *frame.mutable_hello());
  frame.mutable_hello()->set_protocol_version(version);
  frame.mutable_hello()->mutable_clock()->set_boot_id(clock::boot_id());  // its clock is the host's
  return frame;
}

net::Frame network_list() {
  net::Frame frame;
  frame.mutable_list();
  return frame;
}

net::Frame subscribe_from_oldest() {
  net::Frame frame;
  frame.mutable_subscribe()->set_from_oldest(true);
  return frame;
}

LocalWriter::LocalWriter(RawClient& client, const std::string& name, std::uint64_t payload_bytes,
                         std::uint64_t depth)
    : name_(name), payload_(payload_bytes) {
  local::Request request = create_request(name, depth);
  request.mutable_create()->mutable_type()->clear_name();
  request.mutable_create()->mutable_type()->set_payload_bytes(payload_bytes);
  Answer answer = client.ask(request);
  EXPECT_TRUE(answer.response.has_opened()) << answer.response.failure().message();
  descriptors_ = std::move(answer.descriptors);
  mapping_ =
      ring::RingMapping::open_untrusted(descriptors_.at(0).get(), ring::Access::read_write).value();
  bell_ = ring::Bell::open_untrusted(descriptors_.at(1).get()).value();
}

void LocalWriter::offer(RawClient& client) const {
  const Answer answer = client.ask(offer_request(name_, true), numbers(descriptors_));
  EXPECT_TRUE(answer.response.has_opened()) << answer.response.failure().message();
}

Tid LocalWriter::write() {
  ring::RingWriter writer(*mapping_, *bell_, descriptors_.at(3).get());
  const Tid tid = writer.newest() + 1;
  fill_payload(tid, payload_);
  return writer.write(payload_, time_from_ns(1'000'000 + tid * 1000), Duration(5));
}

// Words, so that a test of 64 MiB samples takes no minutes.
void fill_payload(Tid tid, std::span<std::byte> payload) {
  for (std::size_t at = 0; at < payload.size(); at += 8) {
    const std::uint64_t word = (static_cast<std::uint64_t>(tid) << 32) + at;
    std::memcpy(payload.data() + at, &word, std::min<std::size_t>(8, payload.size() - at));
  }
}

bool is_payload_of(Tid tid, std::span<const std::byte> payload) {
  for (std::size_t at = 0; at < payload.size(); at += 8) {
    const std::uint64_t word = (static_cast<std::uint64_t>(tid) << 32) + at;
    if (std::memcmp(payload.data() + at, &word, std::min<std::size_t>(8, payload.size() - at))) {
      return false;
    }
  }
  return true;
}

std::uint64_t private_memory(pid_t pid) {
  std::ifstream file("/proc/" + std::to_string(pid) + "/status");
  for (std::string line; std::getline(file, line);) {
    if (line.starts_with("RssAnon:")) return std::stoull(line.substr(8)) << 10;
  }
  ADD_FAILURE() << "the kernel does not tell RssAnon";
  return 0;
}

}  // namespace dssm::test
