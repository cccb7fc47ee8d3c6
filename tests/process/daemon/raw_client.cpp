// SPDX-License-Identifier: Apache-2.0
#include "tests/process/daemon/raw_client.hpp"

#include <gtest/gtest.h>
#include <poll.h>
#include <sys/socket.h>

#include <algorithm>
#include <chrono>
#include <filesystem>
#include <thread>

#include "core/wire/local_protocol.hpp"

namespace dssm::test {

RawClient::RawClient(const std::string& socket_path, bool greet, const std::string& program) {
  Result<UniqueFd> connected = wire::connect_unix(socket_path);
  EXPECT_TRUE(connected) << connected.error().message;
  if (!connected) return;
  socket_ = *std::move(connected);
  const timeval timeout{kTimeoutSeconds, 0};
  ::setsockopt(socket_.get(), SOL_SOCKET, SO_RCVTIMEO, &timeout, sizeof timeout);
  ::setsockopt(socket_.get(), SOL_SOCKET, SO_SNDTIMEO, &timeout, sizeof timeout);
  if (!greet) return;
  local::Request hello;
  hello.mutable_hello()->set_protocol_version(wire::kLocalProtocolVersion);
  hello.mutable_hello()->set_program(program);
  const Answer answer = ask(hello);
  EXPECT_TRUE(answer.response.has_hello()) << answer.response.failure().message();
}

std::uint64_t RawClient::send(local::Request request, std::span<const int> descriptors) {
  request.set_serial(++serial_);
  send_bytes(wire::encode_frame(request), descriptors);
  return serial_;
}

void RawClient::send_bytes(std::string_view bytes, std::span<const int> descriptors) {
  auto rest = std::as_bytes(std::span(bytes));
  while (!rest.empty()) {
    const auto sent = wire::send_some(socket_.get(), rest, descriptors);
    // A dssmd that hangs up on us while we send is for receive() to notice.
    if (!sent || sent->status != wire::IoStatus::ok) return;
    rest = rest.subspan(sent->bytes);
    descriptors = {};
  }
}

Answer RawClient::receive() {
  Answer answer;
  for (;;) {
    const auto frame = input_.next();
    EXPECT_TRUE(frame) << frame.error().message;
    if (!frame) break;
    if (*frame) {
      EXPECT_TRUE(
          answer.response.ParseFromArray((*frame)->data(), static_cast<int>((*frame)->size())));
      answer.descriptors = std::exchange(descriptors_, {});
      return answer;
    }
    const auto got = wire::recv_some(socket_.get(), input_.space(), descriptors_);
    EXPECT_TRUE(got) << got.error().message;
    if (!got) break;
    EXPECT_NE(got->status, wire::IoStatus::would_block) << "dssmd does not answer";
    if (got->status != wire::IoStatus::ok) break;
    input_.commit(got->bytes);
  }
  answer.ended = true;
  return answer;
}

Answer RawClient::ask(local::Request request, std::span<const int> descriptors) {
  const std::uint64_t serial = send(std::move(request), descriptors);
  for (;;) {
    Answer answer = receive();
    if (answer.ended || answer.response.serial() == serial) return answer;
  }
}

bool RawClient::has_answer() {
  pollfd fd{socket_.get(), POLLIN, 0};
  return ::poll(&fd, 1, 0) > 0;
}

local::Request create_request(const std::string& name, std::uint64_t depth) {
  local::Request request;
  proto::Create& create = *request.mutable_create();
  create.mutable_id()->set_name(name);
  create.mutable_type()->set_name("Odometry");
  create.mutable_type()->set_payload_bytes(24);
  create.mutable_type()->set_alignment_bytes(8);
  create.set_depth(depth);
  create.set_cycle_ns(10'000'000);
  return request;
}

local::Request open_request(const std::string& name, bool for_writing) {
  local::Request request;
  request.mutable_open()->mutable_id()->set_name(name);
  request.mutable_open()->set_for_writing(for_writing);
  return request;
}

local::Request offer_request(const std::string& name, bool for_writing) {
  local::Request request;
  request.mutable_offer()->mutable_id()->set_name(name);
  request.mutable_offer()->set_for_writing(for_writing);
  return request;
}

local::Request list_request() {
  local::Request request;
  request.mutable_list();
  return request;
}

local::Request list_opens_request() {
  local::Request request;
  request.mutable_list_opens();
  return request;
}

local::Request list_clients_request() {
  local::Request request;
  request.mutable_list_clients();
  return request;
}

std::string numbered(std::string name, std::size_t number) {
  return name.append(std::to_string(number));
}

std::vector<int> numbers(const std::vector<UniqueFd>& descriptors) {
  std::vector<int> result;
  for (const UniqueFd& fd : descriptors) result.push_back(fd.get());
  return result;
}

int open_descriptors(pid_t pid) {
  int count = 0;
  for ([[maybe_unused]] const auto& entry :
       std::filesystem::directory_iterator("/proc/" + std::to_string(pid) + "/fd")) {
    ++count;
  }
  return count;
}

int idle_descriptors(pid_t pid) {
  int least = open_descriptors(pid);
  for (int i = 0; i < 50; ++i) {
    std::this_thread::sleep_for(std::chrono::milliseconds(2));
    least = std::min(least, open_descriptors(pid));
  }
  return least;
}

}  // namespace dssm::test
