// SPDX-License-Identifier: Apache-2.0
//
// The dssmd of another host for tests of control connections.
#pragma once

#include <string>
#include <utility>
#include <vector>

#include "tests/support/log_recorder.hpp"
#include "tests/unit/daemon/daemon_fixtures.hpp"
#include "tests/unit/daemon/remote/fake_owner.hpp"

namespace dssm::daemon {

inline net::Frame answer_to(const net::Frame& request) {
  net::Frame answer;
  answer.set_serial(request.serial());
  return answer;
}

// A peer that answers heartbeats and Watch by itself.
class FakePeer {
 public:
  explicit FakePeer(const EventLoop& loop, const std::string& name = "pc2")
      : owner(loop, name), delay_timer_(EventSource::timer(loop, [this] {
          for (const net::Frame& pong : std::exchange(delayed_, {})) owner.send(pong);
        })) {}

  // Answers what came; to be called while waiting for something.
  void serve() {
    while (owner.asked()) {
      const net::Frame request = owner.take();
      net::Frame answer = answer_to(request);
      if (request.has_ping()) {
        ++pings;
        if (silent) continue;
        answer.mutable_pong()->mutable_clock()->set_bound_ns(1000);
        answer.mutable_pong()->mutable_clock()->set_anchor(std::string(16, 'r'));
        delayed_.push_back(answer);
        delay_timer_.enable_in(delay);
        continue;
      } else if (request.has_watch()) {
        ++watches;
        for (const std::string& stream : streams) tell(stream, false);
        answer.mutable_done();
      } else {
        asked.push_back(request);
        continue;
      }
      owner.send(answer);
    }
  }
  void tell(const std::string& name, bool removed, const std::string& as_host = "") {
    net::Frame frame;
    proto::StreamEvent& event = *frame.mutable_stream_event();
    event.set_removed(removed);
    event.mutable_stream()->mutable_id()->set_name(name);
    event.mutable_stream()->mutable_id()->set_host(as_host);
    wire::to_message(odometry_type(), *event.mutable_stream()->mutable_type());
    event.mutable_stream()->set_incarnation(1);
    owner.send(frame);
  }

  FakeOwner owner;
  std::vector<std::string> streams;
  std::vector<net::Frame> asked;
  bool silent = false;
  Duration delay{};  // until a ping is answered
  int pings = 0, watches = 0;

 private:
  std::vector<net::Frame> delayed_;
  EventSource delay_timer_;
};

}  // namespace dssm::daemon
