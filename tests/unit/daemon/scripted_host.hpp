// SPDX-License-Identifier: Apache-2.0
//
// The dssmd of another host, in the event loop of a unit test: a server on a loopback port, so that
// the code under test connects to it as to any other. It greets by itself. One connection at a
// time: the newest counts.
//
//   ScriptedHost  queues requests; the test answers them
//   ScriptedPeer  answers the requests of a control connection by itself
#pragma once

#include <event2/event.h>
#include <gtest/gtest.h>
#include <sys/socket.h>

#include <deque>
#include <memory>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "core/wire/messages.hpp"
#include "core/wire/tcp.hpp"
#include "daemon/base/event_loop.hpp"
#include "daemon/fleet/catalog.hpp"
#include "daemon/link/frame_connection.hpp"
#include "tests/support/frames.hpp"
#include "tests/unit/daemon/daemon_fixtures.hpp"
#include "tests/unit/daemon/run_loop.hpp"

namespace dssm::daemon {

using namespace test;

// Listens at a free port of 127.0.0.1.
inline UniqueFd listen_on_loopback() {
  const wire::Address any = wire::Address::parse("127.0.0.1:0", 0, true).value();
  return wire::listen_tcp(wire::resolve_number(any).at(0)).value();
}

class ScriptedHost : private FrameConnection::Observer, private FrameConnection::SampleDelegate {
 public:
  explicit ScriptedHost(const EventLoop& loop, const std::string& host = "pc2")
      : loop_(loop), greeting_(greeting_of(host)), listening_(listen_on_loopback()) {
    host_.greeting = greeting_;
    host_.address =
        wire::Address::parse(wire::local_address(listening_.get()).value().str()).value();
    accepting_ = EventSource::readable(loop, listening_.get(), [this] { accept_one(); });
    accepting_.enable();
  }
  virtual ~ScriptedHost() = default;

  KnownHost& host() { return host_; }
  const wire::Address& address() const { return host_.address; }
  // From the next connection on.
  void greet_as(const wire::Greeting& greeting) { greeting_ = greeting; }
  int connections() const { return connections_; }
  bool connected() const { return connection_ && !ended_; }
  void cut() { connection_.reset(); }

  // The next request, in the order of arrival.
  net::Frame receive() {
    run_until(loop_, [this] { return !requests_.empty(); });
    net::Frame frame = std::move(requests_.front());
    requests_.pop_front();
    return frame;
  }
  bool has_request() const { return !requests_.empty(); }

  void send(const net::Frame& frame) { connection_->send(frame); }
  void fail(const net::Frame& request, Errc code, const std::string& text) {
    send(failure_frame(code, text, request));
  }
  void send_caught_up() {
    net::Frame frame;
    frame.mutable_caught_up();
    send(frame);
  }
  void send_sample(const SampleInfo& info, const Bytes& payload, bool torn = false) {
    connection_->queue_rest(RawBytes::copy_of(sample_bytes(info, payload, 0, torn)));
  }

  // From now on, samples of this size that are published here.
  void take_samples(std::size_t payload_bytes) { connection_->take_samples(payload_bytes, *this); }
  struct Published {
    SampleInfo info;
    Bytes payload;
    std::uint64_t serial = 0;
    bool complete = false;
  };
  std::deque<Published> published;  // which keeps its elements where they are

 protected:
  virtual void on_request(const net::Frame& frame) { requests_.push_back(frame); }

 private:
  void accept_one() {
    UniqueFd socket(::accept4(listening_.get(), nullptr, nullptr, SOCK_NONBLOCK | SOCK_CLOEXEC));
    ASSERT_TRUE(socket);
    wire::set_channel_options(socket.get());
    requests_.clear();
    ended_ = false;
    greeted_ = false;
    connection_.reset(new FrameConnection(
        loop_, wire::make_transport(std::move(socket), wire::TransportEnd::accepted), *this,
        1U << 20));
    ++connections_;
  }
  Result<void> on_frame(net::Frame& frame) override {
    if (!std::exchange(greeted_, true)) {
      send(hello_frame(greeting_));
    } else {
      on_request(frame);
    }
    return {};
  }
  Result<void> on_sample_begin(const wire::IncomingSample& sample, std::byte*& out) override {
    published.push_back({sample.info, Bytes(sample.info.payload_bytes), sample.serial, false});
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
  std::unique_ptr<FrameConnection> connection_;
  bool greeted_ = false, ended_ = false;
  int connections_ = 0;
  std::deque<net::Frame> requests_;
};

class ScriptedPeer final : public ScriptedHost {
 public:
  explicit ScriptedPeer(const EventLoop& loop, const std::string& name = "pc2")
      : ScriptedHost(loop, name), pong_timer_(EventSource::timer(loop, [this] {
          for (const net::Frame& pong : std::exchange(pongs_, {})) send(pong);
        })) {}

  void send_event(const std::string& stream, bool removed, const std::string& host = "") {
    net::Frame frame;
    proto::StreamEvent& event = *frame.mutable_stream_event();
    event.set_removed(removed);
    event.mutable_stream()->mutable_id()->set_name(stream);
    event.mutable_stream()->mutable_id()->set_host(host);
    wire::to_message(odometry_type(), *event.mutable_stream()->mutable_type());
    event.mutable_stream()->set_incarnation(1);
    send(frame);
  }

  std::vector<std::string> streams;  // that it has when a Watch begins
  std::vector<net::Frame> requests;  // of other kinds, which the test answers
  bool answers_heartbeat = true;
  Duration delay{};                                     // until a Ping is answered
  std::int64_t ping_received_ns = 0, pong_sent_ns = 0;  // what its Pongs say
  std::uint64_t carried_bytes_per_s = 0;
  int pings = 0, watches = 0;
  net::Ping last_ping;

 private:
  void on_request(const net::Frame& request) override {
    net::Frame answer = answer_to(request);
    if (request.has_ping()) {
      ++pings;
      last_ping = request.ping();
      if (!answers_heartbeat) return;
      answer.mutable_pong()->mutable_clock()->set_bound_ns(1000);
      answer.mutable_pong()->mutable_clock()->set_anchor(std::string(16, 'r'));
      answer.mutable_pong()->set_received_ns(ping_received_ns);
      answer.mutable_pong()->set_raw_ns(pong_sent_ns);
      answer.mutable_pong()->set_carried_bytes_per_s(carried_bytes_per_s);
      pongs_.push_back(answer);
      pong_timer_.enable_in(delay);
    } else if (request.has_watch()) {
      ++watches;
      for (const std::string& stream : streams) send_event(stream, false);
      answer.mutable_done();
      send(answer);
    } else {
      requests.push_back(request);
    }
  }

  std::vector<net::Frame> pongs_;  // that are delayed
  EventSource pong_timer_;
};

}  // namespace dssm::daemon
