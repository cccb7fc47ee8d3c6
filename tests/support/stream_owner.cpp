// SPDX-License-Identifier: Apache-2.0
#include "tests/support/stream_owner.hpp"

#include <gtest/gtest.h>
#include <poll.h>
#include <sys/socket.h>

#include "core/base/time.hpp"
#include "core/clock/clock_page.hpp"
#include "core/wire/address.hpp"
#include "core/wire/tcp.hpp"

namespace dssm::test {
namespace {

// It has the clock of this PC.
void state_clock(proto::ClockReport& out) {
  out.set_boot_id(clock::boot_id());
  out.set_bound_ns(kUnknownClockError.count());
  out.set_root_bound_ns(kUnknownClockError.count());
}

}  // namespace

StreamOwner::StreamOwner() {
  const auto any = wire::Address::parse("127.0.0.1:0", wire::kDefaultPort, true).value();
  listener_ = wire::listen_tcp(wire::resolve_number(any).at(0)).value();
  address_ = wire::local_address(listener_.get())->str();
  info_.id = {"late", 0, "fake"};
  info_.type = {"", 8, 8, {}};
  info_.depth = 64;
  info_.cycle = std::chrono::milliseconds(10);
  info_.incarnation = 7;
  info_.oldest = info_.newest = kNoTid;
  accepting_ = std::thread([this] { accept(); });
}

StreamOwner::~StreamOwner() {
  ::shutdown(listener_.get(), SHUT_RDWR);  // ends accept()
  accepting_.join();
  {
    const std::lock_guard guard(mutex_);
    for (const int socket : sockets_) {
      if (socket >= 0) ::shutdown(socket, SHUT_RDWR);
    }
  }
  for (std::thread& connection : connections_) connection.join();
}

void StreamOwner::accept() {
  for (;;) {
    pollfd ready{listener_.get(), POLLIN, 0};
    while (::poll(&ready, 1, -1) < 0) continue;
    UniqueFd socket(::accept4(listener_.get(), nullptr, nullptr, SOCK_CLOEXEC));
    if (!socket) return;
    wire::set_channel_options(socket.get());
    const std::lock_guard guard(mutex_);
    const std::size_t number = sockets_.size();
    sockets_.push_back(socket.get());
    connections_.emplace_back([this, number, peer = NetworkPeer(std::move(socket))]() mutable {
      serve(peer);
      const std::lock_guard ended(mutex_);
      sockets_[number] = -1;
      if (channel_ == &peer) channel_ = nullptr;
      peer.close();
    });
  }
}

void StreamOwner::serve(NetworkPeer& peer) {
  while (const std::optional<net::Frame> request = peer.try_receive()) {
    const std::lock_guard guard(mutex_);
    peer.send(answer(*request, peer));
    if (!request->has_subscribe()) continue;
    net::Frame caught_up;
    caught_up.mutable_caught_up();
    peer.send(caught_up);
    subscribed_.notify_all();
  }
}

net::Frame StreamOwner::answer(const net::Frame& request, NetworkPeer& peer) {
  net::Frame answer = answer_to(request);
  if (request.has_hello()) {
    wire::Greeting greeting = greeting_of("fake");
    greeting.instance_id = 1;  // the same dssmd on each connection
    greeting.features.emplace_back(wire::kFeatureNewestFirst);
    net::Frame hello = hello_frame(greeting);
    state_clock(*hello.mutable_hello()->mutable_clock());
    return hello;
  }
  if (request.has_watch()) {
    net::Frame event;
    wire::to_message(info_, *event.mutable_stream_event()->mutable_stream());
    peer.send(event);
    answer.mutable_done();
  } else if (request.has_ping()) {
    state_clock(*answer.mutable_pong()->mutable_clock());
  } else if (request.has_list() || request.has_info()) {
    wire::to_message(info_, *answer.mutable_stream_list()->add_streams());
  } else if (request.has_open()) {
    return opened_frame(request, info_);
  } else if (request.has_subscribe()) {
    channel_ = &peer;
    answer = subscribed_frame(request, info_.incarnation, request.subscribe().from_tid());
    answer.mutable_subscribed()->set_newest_first(true);
  } else {
    return failure_frame(Errc::protocol, "not known here", request);
  }
  return answer;
}

void StreamOwner::send_sample(Tid tid) {
  const SampleInfo info{tid, WallClock::now(), Duration(1), info_.type.payload_bytes};
  const Bytes payload(info_.type.payload_bytes, static_cast<std::byte>(tid));
  std::unique_lock lock(mutex_);
  subscribed_.wait(lock, [this] { return channel_ != nullptr; });
  channel_->send_sample(info, payload);
}

}  // namespace dssm::test
