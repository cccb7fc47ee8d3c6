// SPDX-License-Identifier: Apache-2.0
//
// The owner of streams for tests of mirrors and remote writers: a server on a loopback port that
// greets by itself, keeps what it is asked, and answers what the test wants. One connection at a
// time: the newest counts.
#pragma once

#include <event2/event.h>
#include <gtest/gtest.h>
#include <sys/socket.h>

#include <deque>
#include <functional>
#include <memory>
#include <optional>
#include <utility>
#include <vector>

#include "core/wire/messages.hpp"
#include "core/wire/network_protocol.hpp"
#include "core/wire/sample_frame.hpp"
#include "core/wire/tcp.hpp"
#include "daemon/base/event_loop.hpp"
#include "daemon/fleet/catalog.hpp"
#include "daemon/link/frame_connection.hpp"
#include "daemon/link/raw_bytes.hpp"
#include "tests/unit/daemon/run_loop.hpp"

namespace dssm::daemon {

inline wire::Greeting greeting_of(const std::string& host) {
  wire::Greeting greeting;
  greeting.host = host;
  greeting.host_id = wire::host_id_for(host);
  greeting.instance_id = wire::random_number();
  greeting.program = "dssmd";
  greeting.version = "0.0";
  greeting.features = {std::string(wire::kFeatureTorn)};
  return greeting;
}

class FakeOwner final : private FrameConnection::Observer, private FrameConnection::SampleDelegate {
 public:
  explicit FakeOwner(const EventLoop& loop, const std::string& host = "pc2")
      : loop_(loop), greeting_(greeting_of(host)) {
    const wire::Address any = wire::Address::parse("127.0.0.1:0", 0, true).value();
    listening_ = wire::listen_tcp(wire::resolve_number(any).at(0)).value();
    const wire::SocketAddress bound = wire::local_address(listening_.get()).value();
    host_.greeting = greeting_;
    host_.address = wire::Address::parse(bound.str()).value();
    accepting_ = EventSource::readable(loop, listening_.get(), [this] { accept_one(); });
    accepting_.enable();
  }

  KnownHost& host() { return host_; }
  void call_itself(const std::string& name) { greeting_ = greeting_of(name); }
  void greet_as(const wire::Greeting& greeting) { greeting_ = greeting; }
  int connections() const { return connections_; }
  bool connected() const { return link_ && !ended_; }

  // The next request that is none yet taken.
  net::Frame take() {
    run_until(loop_, [this] { return !got_.empty(); });
    net::Frame frame = std::move(got_.front());
    got_.pop_front();
    return frame;
  }
  bool asked() const { return !got_.empty(); }

  void send(const net::Frame& frame) { link_->send(frame); }
  void fail(const net::Frame& request, Errc code, const std::string& text) {
    net::Frame frame;
    frame.set_serial(request.serial());
    wire::to_message(Error{code, text}, *frame.mutable_failure());
    send(frame);
  }
  void say(const StreamInfo& stream, const net::Frame& request) {
    net::Frame frame;
    frame.set_serial(request.serial());
    wire::to_message(stream, *frame.mutable_opened()->mutable_stream());
    send(frame);
  }
  void subscribed(const net::Frame& request, std::uint64_t incarnation, Tid first) {
    net::Frame frame;
    frame.set_serial(request.serial());
    frame.mutable_subscribed()->set_incarnation(incarnation);
    frame.mutable_subscribed()->set_first_tid(first);
    send(frame);
  }
  void caught_up() {
    net::Frame frame;
    frame.mutable_caught_up();
    send(frame);
  }
  void gap(Tid first, std::uint64_t count) {
    net::Frame frame;
    frame.mutable_gap()->set_first_tid(first);
    frame.mutable_gap()->set_count(count);
    send(frame);
  }
  void removed() {
    net::Frame frame;
    frame.mutable_ended()->set_removed(true);
    send(frame);
  }
  void sample(const SampleInfo& info, const std::vector<std::byte>& payload, bool torn = false) {
    std::array<std::byte, wire::kMaxSampleHeaderBytes> header;
    const std::size_t bytes =
        wire::encode_sample_header(header, 0, info, payload.size(), wire::Trailer::torn);
    const auto trailer = wire::torn_trailer(torn);
    std::vector<std::byte> all(header.begin(), header.begin() + static_cast<std::ptrdiff_t>(bytes));
    all.insert(all.end(), payload.begin(), payload.end());
    all.insert(all.end(), trailer.begin(), trailer.end());
    link_->queue_rest(RawBytes::copy_of(all));
  }
  void cut() { link_.reset(); }

  // The samples that were published here, as they came.
  void take_samples(std::size_t payload_bytes) { link_->take_samples(payload_bytes, *this); }
  struct Published {
    SampleInfo info;
    std::vector<std::byte> payload;
    std::uint64_t serial = 0;
    bool complete = false;
  };
  std::deque<Published> published;  // which keeps its elements where they are

 private:
  void accept_one() {
    UniqueFd socket(::accept4(listening_.get(), nullptr, nullptr, SOCK_NONBLOCK | SOCK_CLOEXEC));
    ASSERT_TRUE(socket);
    wire::set_channel_options(socket.get());
    got_.clear();
    ended_ = false;
    greeted_ = false;
    link_.reset(new FrameConnection(
        loop_, wire::make_transport(std::move(socket), wire::TransportEnd::accepted), *this,
        1U << 20));
    ++connections_;
  }
  Result<void> on_frame(net::Frame& frame) override {
    if (!std::exchange(greeted_, true)) {
      net::Frame hello;
      wire::to_message(greeting_, *hello.mutable_hello());
      link_->send(hello);
    } else {
      got_.push_back(std::move(frame));
    }
    return {};
  }
  Result<void> on_sample_begin(const wire::IncomingSample& sample, std::byte*& out) override {
    published.push_back(
        {sample.info, std::vector<std::byte>(sample.payload_bytes), sample.serial, false});
    out = published.back().payload.data();
    return {};
  }
  Result<void> on_sample_end(const wire::IncomingSample&, bool torn) override {
    published.back().complete = true;
    if (torn) published.pop_back();
    return {};
  }
  void on_closed(const Error&) override { ended_ = true; }

  const EventLoop& loop_;
  wire::Greeting greeting_;
  KnownHost host_;
  UniqueFd listening_;
  EventSource accepting_;
  std::unique_ptr<FrameConnection> link_;
  bool greeted_ = false, ended_ = false;
  int connections_ = 0;
  std::deque<net::Frame> got_;
};

}  // namespace dssm::daemon
