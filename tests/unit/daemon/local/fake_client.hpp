// SPDX-License-Identifier: Apache-2.0
//
// A program of this PC as LocalService sees it, without a socket, and the requests that tests make.
#pragma once

#include <gtest/gtest.h>

#include <cstring>
#include <deque>
#include <string>
#include <vector>

#include "core/wire/frame.hpp"
#include "daemon/local/local_service.hpp"
#include "tests/support/log_recorder.hpp"
#include "tests/unit/daemon/daemon_fixtures.hpp"

namespace dssm::daemon {

// A LocalService with all that it works on. fleet: as in its constructor.
struct LocalDaemon {
  explicit LocalDaemon(bool recovering = false, const OpenTable::Limits& limits = {1000, 100},
                       Fleet* fleet = nullptr)
      : opens(limits), service(registry, opens, clock, rights, logger, fleet) {
    if (recovering) registry.begin_recovery(Registry::Recovery::streams);
  }
  LogRecorder logger;
  Registry registry{"pc1", kLimits};
  OpenTable opens;
  PlaybackClockOwner clock;
  Rights rights;
  LocalService service;
};

// A client without a socket: what it is sent, decoded.
class FakeClient final : public ClientOutput {
 public:
  FakeClient(LocalService& service, std::int32_t pid, std::uint32_t uid = 1000)
      : service_(service), number_(service.connect(program_of(pid, uid), *this)) {}
  ~FakeClient() { service_.disconnect(number_); }

  void send(std::string bytes, std::vector<UniqueFd> descriptors) override {
    if (ends_at_next) return stop_reading();
    for (std::string_view rest = bytes; !rest.empty();) {
      const auto space = buffer.space();
      const std::size_t part = std::min(space.size(), rest.size());
      std::memcpy(space.data(), rest.data(), part);
      buffer.commit(part);
      rest.remove_prefix(part);
    }
    const auto message = buffer.next();
    ASSERT_TRUE(message);
    if (!*message) return;  // the rest is to come
    local::Response response;
    ASSERT_TRUE(response.ParseFromArray((*message)->data(), static_cast<int>((*message)->size())));
    received.push_back(std::move(response));
    received_descriptors.push_back(std::move(descriptors));
  }

  void request_turn() override { wants_turn = true; }
  void stop_reading() { service_.on_reader_gone(number_); }
  // Its turn, if it wants one; false: it needs no other one.
  bool take_turn() {
    wants_turn = wants_turn && service_.go_on(number_);
    return wants_turn;
  }

  bool put(const local::Request& request) {
    const std::string bytes = request.SerializeAsString();
    const bool goes_on =
        service_.on_frame_untrusted(number_, std::as_bytes(std::span(bytes)), offered);
    take_turn();
    return goes_on;
  }

  // Sends `request` under a new serial and gives what came back first.
  local::Response ask(local::Request request) {
    request.set_serial(++serial_);
    EXPECT_TRUE(put(request));
    return next();
  }

  local::Response next() {
    while (received.empty() && take_turn()) {
    }
    if (received.empty()) {
      ADD_FAILURE() << "nothing was sent";
      return {};
    }
    local::Response response = std::move(received.front());
    received.pop_front();
    last_descriptors = std::move(received_descriptors.front());
    received_descriptors.pop_front();
    return response;
  }

  FakeClient& greet() {
    local::Request hello;
    hello.mutable_hello()->set_protocol_version(wire::kLocalProtocolVersion);
    hello.mutable_hello()->set_program("test");
    EXPECT_TRUE(ask(hello).has_hello());
    return *this;
  }

  wire::FrameBuffer buffer{wire::kMaxLocalFrameBytes};
  std::deque<local::Response> received;
  std::deque<std::vector<UniqueFd>> received_descriptors;
  std::vector<UniqueFd> last_descriptors;
  DescriptorQueue offered;
  bool wants_turn = false;
  bool ends_at_next = false;  // what it is sent next finds that it does not read any more

 private:
  static Identity program_of(std::int32_t pid, std::uint32_t uid) {
    Identity identity;
    identity.pid = pid;
    identity.uid = uid;
    return identity;
  }

  LocalService& service_;
  ClientNumber number_;
  std::uint64_t serial_ = 0;
};

inline local::Request create_request(const std::string& name) {
  local::Request request;
  proto::Create& create = *request.mutable_create();
  create.mutable_id()->set_name(name);
  wire::to_message(odometry_type(), *create.mutable_type());
  create.set_depth(16);
  create.set_cycle_ns(10'000'000);
  create.set_tag(7);
  return request;
}

inline local::Request open_request(const std::string& name, bool for_writing = false) {
  local::Request request;
  request.mutable_open()->mutable_id()->set_name(name);
  request.mutable_open()->set_for_writing(for_writing);
  return request;
}

inline local::Request list_request() {
  local::Request request;
  request.mutable_list();
  return request;
}

}  // namespace dssm::daemon
